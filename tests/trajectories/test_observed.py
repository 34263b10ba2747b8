"""`observed`: the states as logged, beside those that a transformer estimated."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._matching import with_states_of
from trajlearn.trajectories import TrajectoryDataset


def estimated(ds, states=None, names=None):
    """As a transformer leaves it: other states, the old ones observed."""
    states = -ds.states if states is None else states
    columns = replace(ds._columns, states=states, observed=ds.states)
    kept = ds._names | {"states": names or ds.state_names, "observed": ds.state_names}
    return TrajectoryDataset._of(columns.freeze(), kept)


@pytest.fixture
def ds():
    rng = np.random.default_rng(0)
    raw = [rng.normal(size=(n, 2)) for n in (7, 5, 9)]
    fields = {"params": [[1.0], [2.0], [3.0]], "times": [0.5 * np.arange(n) for n in (7, 5, 9)]}
    return estimated(TrajectoryDataset.from_arrays(raw, state_names=["x", "v"], **fields))


def test_absent_where_no_transformer_was():
    plain = TrajectoryDataset.from_arrays([[[0.0], [1.0]]])
    assert plain.observed is None
    assert plain.observed_names == ()
    assert "observed" not in repr(plain)


def test_present(ds):
    np.testing.assert_array_equal(ds.observed, -ds.states)
    assert ds.observed_names == ("x", "v")
    assert "observed" in repr(ds)
    assert "observed_names" not in ds.names
    assert not ds.observed.flags.writeable


@pytest.mark.parametrize(
    "edit",
    [
        lambda ds: ds[[2, 0]],
        lambda ds: ds.truncate(3),
        lambda ds: ds.window(2, stride=1),
        lambda ds: ds.decimate(2),
        lambda ds: ds.resample(0.3),
        lambda ds: ds.concatenate(ds),
        lambda ds: pickle.loads(pickle.dumps(ds)),
    ],
    ids=["index", "truncate", "window", "decimate", "resample", "concatenate", "pickle"],
)
def test_rows_stay_with_their_states(ds, edit):
    edited = edit(ds)
    np.testing.assert_allclose(edited.observed, -edited.states, atol=1e-12)
    assert edited.observed_names == ("x", "v")


def test_selecting_states_keeps_all_observed(ds):
    one = ds.select_states(["v"])
    assert one.state_names == ("v",)
    np.testing.assert_array_equal(one.observed, ds.observed)


def test_equality_sees_it(ds):
    other = estimated(ds, ds.states)
    assert other != ds
    assert ds == ds[:]


HINDSIGHT = {
    "index": lambda ds: ds[[2, 0]],
    "truncate": lambda ds: ds.truncate(3),
    "window": lambda ds: ds.window(2, stride=1),
    "decimate": lambda ds: ds.decimate(2),
    "resample": lambda ds: ds.resample(0.3),
    "select": lambda ds: ds.select_states(["v"]),
    "noise": lambda ds: ds.add_noise(0.1),
    "assign": lambda ds: ds.assign(params=[5.0]),
    "pickle": lambda ds: pickle.loads(pickle.dumps(ds)),
}


@pytest.mark.parametrize("edit", HINDSIGHT)
def test_hindsight_stays(ds, edit):
    marked = TrajectoryDataset._of(replace(ds._columns, hindsight=True), ds._names)
    assert HINDSIGHT[edit](marked).hindsight
    assert not HINDSIGHT[edit](ds).hindsight


def test_hindsight_of_one_is_that_of_all(ds):
    marked = TrajectoryDataset._of(replace(ds._columns, hindsight=True), ds._names)
    assert ds.concatenate(marked).hindsight
    assert marked.concatenate(ds).hindsight
    assert not ds.concatenate(ds).hindsight
    assert marked != ds
    assert "hindsight" in repr(marked)
    assert "hindsight" not in repr(ds)


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_files_keep_hindsight(ds, tmp_path, suffix):
    marked = TrajectoryDataset._of(replace(ds._columns, hindsight=True), ds._names)
    marked.save(tmp_path / f"log{suffix}")
    assert TrajectoryDataset.load(tmp_path / f"log{suffix}") == marked


def test_datasets_with_and_without_it_do_not_join(ds):
    plain = TrajectoryDataset.from_arrays(
        [np.zeros((3, 2))], state_names=["x", "v"], params=[[1.0]]
    )
    with pytest.raises(ValueError, match="observed"):
        ds.concatenate(plain)


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_files_keep_it(ds, tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    ds.save(path)
    assert TrajectoryDataset.load(path) == ds


def test_tables_show_it(ds):
    frame = ds.to_frame()
    np.testing.assert_array_equal(frame[["observed_x", "observed_v"]], ds.observed)
    assert ("observed", "x") in ds.describe().index


# -- forecasts are compared with it -----------------------------------------------------------


def forecast_of(ds, mean, names):
    """Forecasts of all steps from the first state, the same `mean` (d_s,) at each."""
    n, steps = len(ds), ds.lengths
    horizons = np.arange(1, steps.max() + 1)
    known = horizons <= steps[:, None]
    values = np.where(known[..., None], np.asarray(mean, dtype=float), np.nan)
    d_s = values.shape[-1]
    return Forecast(
        values,
        times=np.where(known, 0.5 * horizons, np.nan),
        horizons=horizons,
        lengths=steps,
        initial_states=np.zeros((n, d_s)),
        initial_times=np.zeros(n),
        start=np.zeros(n, dtype=int),
        diverged_at=np.zeros(n, dtype=int),
        state_range=np.stack([np.zeros(d_s), 2.0 ** np.arange(d_s)]),
        state_names=tuple(names),
    )


def test_errors_are_against_observed_states(ds):
    squared = forecast_of(ds, [0.0, 0.0], ["x", "v"]).squared_errors(ds)
    truth = ds.observed[ds.offsets[2] + 1 : ds.offsets[3]]
    np.testing.assert_allclose(squared[2], (truth / [1, 2]) ** 2)


def test_states_that_were_never_logged_are_not_compared(ds):
    # the range of v is 4: it is the third state of the forecast
    forecast = forecast_of(ds, [0.0, 5.0, 0.0], ["x", "d_x", "v"])
    squared = forecast.squared_errors(ds)
    assert squared.shape[-1] == 2
    truth = ds.observed[ds.offsets[2] + 1 : ds.offsets[3]]
    np.testing.assert_allclose(squared[2], (truth / [1, 4]) ** 2)


def test_selected_states_are_compared_by_name(ds):
    squared = forecast_of(ds, [0.0], ["v"]).squared_errors(ds)
    truth = ds.observed[ds.offsets[2] + 1 : ds.offsets[3], 1:]
    np.testing.assert_allclose(squared[2], truth**2)


def test_estimated_velocity_is_not_taken_for_another_state(ds):
    squared = forecast_of(ds, [0.0, 5.0], ["x", "d_x"]).squared_errors(ds)
    assert squared.shape[-1] == 1


def test_other_states_are_refused(ds):
    with pytest.raises(ValueError, match=r"states \(x, y, z\)"):
        forecast_of(ds, np.zeros(3), ["x", "y", "z"]).squared_errors(ds)


def test_truth_of_a_forecast(ds):
    truth = with_states_of(forecast_of(ds, np.zeros(3), ["v", "x", "d_x"]), ds)
    assert truth.state_names == ("v", "x")
    assert truth.observed is None
    np.testing.assert_array_equal(truth.states, ds.observed[:, ::-1])
