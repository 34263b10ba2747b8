import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from trajlearn import TrajectoryDataset
from trajlearn.evaluation import horizon_errors, reward_errors, summarise

INF, NAN = np.inf, np.nan


# -- horizon_errors -----------------------------------------------------------------------


def test_errors_are_squared_in_training_ranges_and_averaged_over_states(persistence, make_ramps):
    # training range: 0..8 and 0..80; off by 1, 2, 3 steps of slope 2, that is 2/8, 4/8, 6/8
    model = persistence().fit(make_ramps([2.0], [4]))
    test = make_ramps([2.0], [3], ids=["a"])
    errors = horizon_errors(model.predict(test), test)
    assert_allclose(errors.loc["a"], [1 / 16, 1 / 4, 9 / 16])
    assert list(errors.columns) == [1, 2, 3]
    assert (errors.index.name, errors.columns.name) == ("episode", "horizon")
    # one state perfect, the other off by its range: half
    flat = TrajectoryDataset.from_arrays([[[0.0, 0.0], [0.0, 80.0]]], state_names=["x", "y"])
    assert_allclose(horizon_errors(model.predict(flat), flat), [[0.5]])


def test_steps_that_an_episode_does_not_have_are_nan(persistence, make_ramps):
    ds = make_ramps([1.0, 1.0], [2, 4])
    errors = horizon_errors(persistence().fit(ds).predict(ds), ds)
    assert_allclose(errors, np.array([[1, 4, NAN, NAN], [1, 4, 9, 16]]) / 16)


def test_steps_that_were_not_forecast_are_nan(persistence, make_ramps):
    ds = make_ramps([1.0, 1.0], [4, 4])
    model = persistence(diverges_at=2).fit(ds)
    forecast = np.concatenate([model.predict(ds[:1], horizon=2), model.predict(ds[1:])])
    errors = horizon_errors(forecast, ds)
    assert_allclose(errors, [[1 / 16, INF, NAN, NAN], [1 / 16, INF, INF, INF]])


def test_a_diverged_forecast_is_infinitely_wrong_but_only_where_it_is_compared(
    persistence, make_ramps
):
    ds = make_ramps([1.0, 1.0], [2, 4])
    errors = horizon_errors(persistence(diverges_at=2).fit(ds).predict(ds), ds)
    assert_allclose(errors, [[1 / 16, INF, NAN, NAN], [1 / 16, INF, INF, INF]])


def test_several_starts_have_a_row_each(decays):
    from sklearn.linear_model import LinearRegression

    from trajlearn import TrajectoryRegressor

    model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(decays)
    ds = decays[:3]
    both = horizon_errors(model.predict(ds, start=[[0, 15]] * 3, horizon=5), ds)
    assert both.index.names == ["episode", "start"]
    assert list(both.index) == [(i, t) for i in range(3) for t in (0, 15)]
    late = horizon_errors(model.predict(ds, start=15, horizon=5), ds)
    assert_allclose(both.xs(15, level="start"), late)
    assert summarise(both)["n_episodes"].tolist() == [3] * 5


def test_tables_say_what_was_compared(persistence, make_ramps):
    ds = make_ramps([1.0], [3])
    forecast = persistence().fit(ds).predict(ds)
    forecast.actions = "logged"
    assert horizon_errors(forecast, ds).attrs == {"truth": "observed", "actions": "logged"}
    assert summarise(horizon_errors(forecast, ds, truth_kind="true")).attrs["truth"] == "true"
    with pytest.raises(ValueError, match='choose "observed" or "true"'):
        horizon_errors(forecast, ds, truth_kind="noisy")


def test_states_are_matched_by_name(persistence, make_ramps):
    ds = make_ramps([1.0], [3])
    only_y = ds.select_states(["y"])
    forecast = persistence().fit(only_y).predict(only_y)
    assert_allclose(horizon_errors(forecast, ds), horizon_errors(forecast, only_y))
    swapped = ds.select_states(["y", "x"])
    forecast = persistence(offset=1.0).fit(ds).predict(ds)
    assert_allclose(horizon_errors(forecast, swapped), horizon_errors(forecast, ds))


def test_other_episodes_are_refused(persistence, make_ramps):
    ds = make_ramps([1.0, 1.0, 1.0], [4, 4, 4], dt=0.1)
    model = persistence().fit(ds)
    with pytest.raises(ValueError, match="3 forecasts, but 2 episodes"):
        horizon_errors(model.predict(ds), ds[:2])
    with pytest.raises(ValueError, match=r"is for time 0\.1 at horizon 1.*logged at 0\.2"):
        horizon_errors(model.predict(ds, horizon=2), ds.decimate(2))
    with pytest.raises(ValueError, match="2 states"):
        horizon_errors(model.predict(ds), TrajectoryDataset.from_arrays(np.zeros((3, 5, 1))))


@given(seed=st.integers(0, 1000))
def test_the_order_of_episodes_does_not_matter(persistence, make_ramps, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    ds = make_ramps(rng.normal(size=n), rng.integers(1, 6, n))
    model = persistence(diverges_at=int(rng.integers(0, 4))).fit(ds)
    order = rng.permutation(n)
    errors = horizon_errors(model.predict(ds), ds)
    permuted = horizon_errors(model.predict(ds[order]), ds[order])
    pd.testing.assert_frame_equal(permuted, errors.iloc[order])
    pd.testing.assert_frame_equal(summarise(permuted), summarise(errors))


@given(
    scale=st.floats(1e-3, 1e3),
    shift=st.floats(-100, 100),
    seed=st.integers(0, 1000),
)
def test_units_do_not_matter(persistence, make_ramps, scale, shift, seed):
    rng = np.random.default_rng(seed)
    ds = make_ramps(rng.uniform(1, 2, 3), rng.integers(1, 6, 3))
    other = TrajectoryDataset.from_arrays(
        [episode.states * scale + shift for episode in ds], state_names=ds.state_names
    )
    errors, in_other_units = (
        horizon_errors(persistence().fit(units).predict(units), units) for units in (ds, other)
    )
    assert_allclose(in_other_units, errors, rtol=1e-6)


# -- summarise ----------------------------------------------------------------------------


def summary_of(column):
    return summarise(pd.DataFrame({7: column}, dtype=float)).loc[7]


def test_finite_columns_agree_with_numpy():
    values = np.random.default_rng(0).lognormal(size=(23, 4))
    values[5:, 3] = NAN
    table = summarise(pd.DataFrame(values, columns=[1, 2, 5, 9]))
    assert table.index.tolist() == [1, 2, 5, 9]
    assert table.index.name == "horizon"
    assert table["n_episodes"].tolist() == [23, 23, 23, 5]
    assert not table["n_diverged"].any()
    assert_allclose(table["mean"], np.nanmean(values, axis=0))
    for name, q in {"median": 0.5, "q65": 0.65, "q95": 0.95}.items():
        assert_allclose(table[name], np.nanquantile(values, q, axis=0))


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        ([1, 2, INF], {"median": 2, "mean": INF, "q65": INF, "q95": INF}),
        ([1, INF], {"median": INF}),  # halfway to a diverged one
        ([1, 2, 3, INF], {"median": 2.5, "q65": 2.95, "q95": INF}),
        ([INF, INF, NAN], {"median": INF, "mean": INF, "n_diverged": 2, "n_episodes": 2}),
        ([NAN, 4, NAN], {"median": 4, "mean": 4, "q95": 4, "n_episodes": 1}),
        # ranks 10, 13 and 19 of 0..20 exactly: one diverged forecast is above all three
        ([*range(20), INF], {"median": 10, "q65": 13, "q95": 19, "mean": INF, "n_diverged": 1}),
    ],
)
def test_a_diverged_forecast_counts_as_the_largest_error(column, expected):
    summary = summary_of(column)
    for name, value in expected.items():
        assert_allclose(summary[name], value, err_msg=name)


def test_a_horizon_that_nobody_reaches_has_no_statistics():
    summary = summary_of([NAN, NAN])
    assert summary["n_episodes"] == 0
    assert summary[["median", "mean", "q65", "q95"]].isna().all()


def test_an_episode_with_several_starts_counts_once():
    index = pd.MultiIndex.from_product([["a", "b"], [0, 5]], names=["episode", "start"])
    table = summarise(pd.DataFrame({1: [1.0, INF, 2.0, 3.0], 2: [1.0, NAN, NAN, NAN]}, index))
    assert table["n_episodes"].tolist() == [2, 1]
    assert table["n_diverged"].tolist() == [1, 0]
    assert table.loc[1, "median"] == 2.5


# -- reward_errors ------------------------------------------------------------------------


def test_reward_errors_by_hand():
    errors = reward_errors([1.0, 2.0, 5.0], [1.0, 3.0, 2.0])  # squared: 0, 1, 9
    assert_allclose(errors["mean"], 10 / 3)
    assert_allclose(errors["std"], np.std([0, 1, 9]))
    assert errors["median"] == 1
    assert (errors["n_episodes"], errors["n_diverged"]) == (3, 0)


def test_a_diverged_reward_is_counted_and_spoils_the_mean_not_the_median():
    errors = reward_errors([1.0, 2.0, -INF], [1.0, 3.0, 2.0])
    assert (errors["mean"], errors["std"], errors["median"]) == (INF, INF, 1.0)
    assert errors["n_diverged"] == 1


@pytest.mark.parametrize(
    ("predicted", "true"),
    [
        (np.zeros((3, 1)), np.zeros(3)),
        (np.zeros(3), np.zeros((3, 1))),
        (np.zeros((3, 1)), np.zeros((3, 1))),
        (np.zeros(3), np.zeros(1)),
        (0.0, np.zeros(3)),
        ([], []),
    ],
)
def test_rewards_are_never_broadcast(predicted, true):
    with pytest.raises(ValueError, match="one reward an episode"):
        reward_errors(predicted, true)


@pytest.mark.parametrize(("predicted", "true"), [([NAN], [0]), ([0], [NAN]), ([0], [INF])])
def test_rewards_that_are_not_numbers_are_refused(predicted, true):
    with pytest.raises(ValueError, match="NaN"):
        reward_errors(predicted, true)
