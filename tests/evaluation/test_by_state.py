import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from sklearn.linear_model import LinearRegression

from trajlearn import Forecast, TrajectoryDataset, TrajectoryRegressor
from trajlearn.evaluation import horizon_errors, starts_every, state_errors, summarise

INF, NAN = np.inf, np.nan
STATISTICS = ["rmse", "mae", "median", "q95"]


def walks(rng, n=4):
    """Ragged random episodes of three states of very different size."""
    states = [rng.normal(size=(steps + 1, 3)) * [1, 100, 0.01] for steps in rng.integers(3, 9, n)]
    return TrajectoryDataset.from_arrays(states, state_names=["x", "y", "z"])


def guesses(rng, ds, *, starts=None, diverging=0.0, extra=0):
    """A forecast that is off by noise; `extra` is padding at the end."""
    if starts is None:
        starts = [rng.choice(steps, size=rng.integers(1, 4)) for steps in ds.lengths]
    episode = np.repeat(np.arange(len(ds)), [len(own) for own in starts])
    start = np.concatenate(starts)
    lengths = ds.lengths[episode] - start
    n_horizons = lengths.max() + extra
    mean = np.full((len(start), n_horizons, 3), NAN)
    times = np.full((len(start), n_horizons), NAN)
    diverged_at = np.zeros(len(start), dtype=np.intp)
    for i, (e, s, steps) in enumerate(zip(episode, start, lengths)):
        mean[i, :steps] = ds[int(e)].states[s + 1 :] + rng.normal(size=(steps, 3)) * [1, 100, 0.01]
        times[i, :steps] = ds[int(e)].times[s + 1 :]
        if rng.random() < diverging:
            diverged_at[i] = rng.integers(1, steps + 1)
            mean[i, diverged_at[i] - 1 : steps] = INF
    return Forecast(
        mean,
        times=times,
        horizons=np.arange(1, n_horizons + 1),
        lengths=lengths,
        initial_states=ds.states[ds.offsets[:-1][episode] + start],
        initial_times=ds.times[ds.offsets[:-1][episode] + start],
        start=start,
        diverged_at=diverged_at,
        state_range=np.array([[0.0] * 3, [1.0, 0.0, 7.0]]),
        state_names=ds.state_names,
        episode=episode,
    )


def by_loops(forecast, ds, horizon, columns):
    """Squared and absolute Euclidean errors of each episode, averaged over its starts."""
    squared, absolute = {}, {}
    for i, (e, s) in enumerate(zip(forecast.episode, forecast.start)):
        if s + horizon > ds.lengths[e]:
            continue
        gap = forecast.mean[i, horizon - 1] - ds[int(e)].states[s + horizon]
        distance = np.sqrt(sum(gap[c] ** 2 for c in columns))
        squared.setdefault(e, []).append(distance**2)
        absolute.setdefault(e, []).append(distance)
    return tuple([np.mean(own) for own in found.values()] for found in (squared, absolute))


def row(table, state, horizon):
    chosen = table[(table["state"] == state) & (table["horizon"] == horizon)]
    assert len(chosen) == 1
    return chosen.iloc[0]


@given(seed=st.integers(0, 1000), diverging=st.sampled_from([0.0, 0.3]))
def test_every_entry_agrees_with_loops(seed, diverging):
    rng = np.random.default_rng(seed)
    ds = walks(rng)
    forecast = guesses(rng, ds, diverging=diverging)
    table = state_errors(forecast, ds, norms={"xy": ("x", "y")})
    assert len(table) == 4 * len(forecast.horizons)
    for name, columns in {"x": [0], "y": [1], "z": [2], "xy": [0, 1]}.items():
        for horizon in forecast.horizons:
            found = row(table, name, horizon)
            squared, absolute = by_loops(forecast, ds, horizon, columns)
            assert found["n_episodes"] == len(squared)
            assert found["n_diverged"] == np.isinf(squared).sum()
            if not squared:
                assert found[STATISTICS].isna().all()
                continue
            assert_allclose(found["rmse"], np.sqrt(np.mean(squared)))
            assert_allclose(found["mae"], np.mean(absolute))
            if np.isfinite(squared).all():
                assert_allclose(found["median"], np.median(np.sqrt(squared)))
                assert_allclose(found["q95"], np.quantile(np.sqrt(squared), 0.95))


def test_numbers_by_hand(persistence, make_ramps):
    # the states stand still in the forecast, so that the error at step h is slope * h
    ds = make_ramps([3.0, 4.0], [4, 2])
    forecast = persistence().fit(ds).predict(ds)
    table = state_errors(forecast, ds, horizons=[4, 1], norms={"xy": ["x", "y"]})
    assert list(table) == ["state", "horizon", "n_episodes", "n_diverged", *STATISTICS]
    assert table["state"].tolist() == ["x", "x", "y", "y", "xy", "xy"]
    assert table["horizon"].tolist() == [1, 4] * 3
    assert table["n_episodes"].tolist() == [2, 1] * 3
    assert_allclose(table["rmse"][:4], [np.sqrt(12.5), 12, 10 * np.sqrt(12.5), 120])
    assert_allclose(table["mae"][:4], [3.5, 12, 35, 120])
    assert_allclose(table["q95"][:2], [3 + 0.95, 12])
    assert_allclose(table["rmse"][4:], np.sqrt(101) * table["rmse"][:2])


def test_an_episode_with_many_starts_counts_no_more():
    # episode 0 is right from its one start; episode 1 is off by 2 from each of its nine
    ds = TrajectoryDataset.from_arrays([np.zeros((4, 3)), np.full((10, 3), 2.0)])
    rng = np.random.default_rng(0)
    forecast = guesses(rng, ds, starts=[np.array([0]), np.arange(9)])
    forecast.mean = np.where(np.isnan(forecast.mean), NAN, 0.0)
    found = row(state_errors(forecast, ds), "s0", 1)
    assert_allclose(found[STATISTICS].tolist(), [np.sqrt(2), 1, 1, 0.95 * 2])


def test_the_range_of_the_training_states_does_not_matter(persistence, make_ramps):
    ds = make_ramps([3.0, 4.0], [4, 2])
    tables = []
    for training in (ds, make_ramps([0.001], [1]), make_ramps([0.0], [1])):
        model = persistence().fit(training)
        tables.append(state_errors(model.predict(ds), ds))
        assert (model.predict(ds).state_range == model.state_range_).all()
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0])


@given(seed=st.integers(0, 1000))
def test_order_padding_and_a_shift_of_the_states_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    ds = walks(rng)
    forecast = guesses(rng, ds, diverging=0.2)
    table = state_errors(forecast, ds, norms={"xz": ("x", "z")})

    order = rng.permutation(len(forecast))
    pd.testing.assert_frame_equal(
        state_errors(forecast[order], ds, norms={"xz": ("x", "z")}), table
    )

    shuffled = rng.permutation(len(ds))
    moved = forecast[np.arange(len(forecast))]
    moved.episode = np.argsort(shuffled)[forecast.episode]
    pd.testing.assert_frame_equal(
        state_errors(moved, ds[shuffled], norms={"xz": ("x", "z")}), table
    )

    rng = np.random.default_rng(seed)
    padded = guesses(rng, walks(rng), diverging=0.2, extra=3)
    longer = state_errors(padded, ds, norms={"xz": ("x", "z")})
    reached = longer["horizon"] <= forecast.horizons[-1]
    pd.testing.assert_frame_equal(longer[reached].reset_index(drop=True), table)
    assert (longer.loc[~reached, "n_episodes"] == 0).all()
    assert longer.loc[~reached, STATISTICS].isna().all(axis=None)


def test_a_diverged_forecast_is_infinitely_wrong(persistence, make_ramps):
    ds = make_ramps([1.0, 1.0, 1.0], [2, 4, 4])
    table = state_errors(persistence(diverges_at=3).fit(ds).predict(ds), ds)
    before, after = row(table, "x", 2), row(table, "x", 3)
    assert (before["n_episodes"], before["n_diverged"]) == (3, 0)
    assert (after["n_episodes"], after["n_diverged"]) == (2, 2)
    assert_allclose(before[STATISTICS].tolist(), 2)
    assert np.isinf(after[STATISTICS].astype(float)).all()


# -- skill --------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000))
def test_skill_agrees_with_loops(seed):
    rng = np.random.default_rng(seed)
    ds = walks(rng)
    forecast = guesses(rng, ds)
    starts = [forecast.start[forecast.episode == e] for e in range(len(ds))]
    reference = guesses(rng, ds, starts=starts)
    table = state_errors(forecast, ds, reference=reference, norms={"yz": ("y", "z")})
    for name, columns in {"x": [0], "y": [1], "z": [2], "yz": [1, 2]}.items():
        for horizon in forecast.horizons:
            ours, theirs = (by_loops(f, ds, horizon, columns)[0] for f in (forecast, reference))
            assert_allclose(row(table, name, horizon)["skill"], 1 - np.mean(ours) / np.mean(theirs))


def test_the_marks_of_the_skill(persistence, make_ramps):
    ds = make_ramps([1.0, 2.0], [4, 4])
    model, worse = persistence().fit(ds), persistence(offset=-100.0).fit(ds)
    exploding = persistence(diverges_at=3).fit(ds)

    def skill(of, reference):
        return state_errors(of, ds, reference=reference, horizons=[2, 4])["skill"].tolist()

    base = model.predict(ds)
    right = base[:]
    right.mean = np.stack([episode.states[1:] for episode in ds])
    assert skill(base, base) == [0] * 4
    assert skill(right, base) == [1] * 4
    assert all(0 < value < 1 for value in skill(base, worse.predict(ds)))
    assert all(value < 0 for value in skill(worse.predict(ds), base))
    # diverged: infinitely worse; a reference that diverged is no measure
    assert skill(exploding.predict(ds), base) == [0, -INF] * 2
    assert_allclose(skill(base, exploding.predict(ds)), [0, NAN] * 2)
    # nothing to improve on
    assert skill(base, right) == [-INF] * 4
    assert np.isnan(skill(right, right)).all()
    assert "skill" not in state_errors(base, ds)


def test_skill_compares_the_steps_that_both_forecasts_have(persistence, make_ramps):
    ds = make_ramps([1.0, 5.0], [4, 4])
    model, worse = persistence().fit(ds), persistence(offset=3.0).fit(ds)
    # the reference of the second episode ends after two steps
    reference = np.concatenate([worse.predict(ds[:1]), worse.predict(ds[1:], horizon=2)])
    found = state_errors(model.predict(ds), ds, reference=reference, horizons=4)["skill"]
    alone = state_errors(
        model.predict(ds[:1]), ds[:1], reference=worse.predict(ds[:1]), horizons=4
    )["skill"]
    assert_allclose(found, alone)


def test_a_reference_of_other_starts_or_states_is_refused(persistence, make_ramps):
    ds = make_ramps([1.0, 2.0], [4, 4])
    model = persistence().fit(ds)
    forecast = model.predict(ds)
    for reference in (model.predict(ds, start=1), model.predict(ds[:1])):
        with pytest.raises(ValueError, match="other episodes or starts"):
            state_errors(forecast, ds, reference=reference, horizons=1)
    with pytest.raises(ValueError, match=r"horizons \[3, 4\] were not predicted"):
        state_errors(forecast, ds, reference=model.predict(ds, horizon=2))
    only_y = ds.select_states(["y"])
    of_y = persistence().fit(only_y).predict(only_y)
    with pytest.raises(ValueError, match=r"the reference has no forecast of the states \['x'\]"):
        state_errors(forecast, ds, reference=of_y)
    # the other way round is fine
    table = state_errors(of_y, ds, reference=forecast)
    assert table["state"].unique().tolist() == ["y"]
    assert_allclose(table["skill"], 0)


# -- arguments ----------------------------------------------------------------------------


def test_tables_say_what_was_compared(persistence, make_ramps):
    ds = make_ramps([1.0], [3])
    forecast = persistence().fit(ds).predict(ds)
    forecast.actions = "logged"
    assert state_errors(forecast, ds).attrs == {"truth": "observed", "actions": "logged"}
    assert state_errors(forecast, ds, truth_kind="true").attrs["truth"] == "true"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"norms": {"x": ("x", "y")}}, "'x' has the name of a state"),
        ({"norms": {"xw": ("x", "w")}}, r"norms\['xw'\] = \('x', 'w'\).*forecast: x, y"),
        ({"norms": {"xy": "xy"}}, r"norms\['xy'\] = 'xy' must be a sequence"),
        ({"norms": {"none": ()}}, "must be a sequence of states"),
        ({"horizons": [2, 9]}, r"horizons \[9\] were not predicted"),
        ({"horizons": 0.5}, "whole numbers of steps"),
        ({"truth_kind": "noisy"}, 'choose "observed" or "true"'),
    ],
)
def test_bad_arguments_are_refused(persistence, make_ramps, arguments, message):
    ds = make_ramps([1.0], [4])
    with pytest.raises(ValueError, match=message):
        state_errors(persistence().fit(ds).predict(ds), ds, **arguments)


def test_other_episodes_are_refused(persistence, make_ramps):
    ds = make_ramps([1.0, 1.0], [4, 4], dt=0.1)
    forecast = persistence().fit(ds).predict(ds, horizon=2)
    with pytest.raises(ValueError, match="2 forecasts, but 1 episodes"):
        state_errors(forecast, ds[:1])
    with pytest.raises(ValueError, match="was logged at"):
        state_errors(forecast, ds.decimate(2))


def test_ragged_starts_of_a_real_model(decays):
    ds = decays[:3]
    model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(decays[3:])
    starts = starts_every(ds, 6, first=[0, 5, 13])
    assert [len(own) for own in starts] == [4, 3, 2]
    forecast = model.predict(ds, start=starts)
    found = row(state_errors(forecast, ds), "s0", 2)
    squared = []
    for i, own in enumerate(starts):
        gaps = [
            model.predict(ds[[i]], start=int(s), horizon=2).mean[0, 1, 0] - ds[i].states[s + 2, 0]
            for s in own
            if s + 2 <= 20
        ]
        squared.append(np.mean(np.square(gaps)))
    assert_allclose(found["rmse"], np.sqrt(np.mean(squared)))
    # scaled errors, averaged over the starts of each episode as the docstring of summarise says
    by_episode = horizon_errors(forecast, ds).groupby(level="episode", sort=False).mean()
    scale = np.ptp(decays[3:].states)
    assert_allclose(summarise(by_episode).loc[2, "mean"], np.mean(squared) / scale**2)
