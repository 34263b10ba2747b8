"""Uneven logs and times that no log has, on a few short episodes."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LinearRegression

from benchmarks.paper import _models, _rollouts, _tasks, _uneven_logs, continuous_time
from benchmarks.paper._uneven_logs import ASKED, System
from trajlearn import OneStepRegressor, TrajectoryDataset, TrajectoryRegressor


def shrink(patch):
    patch.setattr(_tasks, "N_EPISODES", 6)
    patch.setitem(_tasks.TASKS, "cartpole", _tasks.Task(24, 48))
    patch.setitem(_rollouts.N_TEST, "quick", 4)
    patch.setattr(_models, "QUICK_STEPS", 20)
    patch.setitem(continuous_time.CONDITIONS, "quick", [("cartpole", 4)])


@pytest.fixture
def small(monkeypatch):
    shrink(monkeypatch)


@pytest.fixture
def unseen(small):
    _, test = _tasks.episodes("cartpole", 0, n_test=4)
    return test


class StepCounter:
    """Forecasts how many steps it was rolled out."""

    def predict(self, ds, **asked):
        count = np.arange(1, ds.lengths[0] + 1)
        return SimpleNamespace(mean=np.tile(count[:, None], (len(ds), 1, ds.states.shape[1])))


# -- logs ---------------------------------------------------------------------------------


def test_irregular_logs_keep_as_many_states_as_a_grid():
    steps = _uneven_logs.irregular_steps(300, 200, 4, np.random.default_rng(0))
    gaps = np.array([np.diff(own) for own in steps])
    assert gaps.shape == (300, 50)
    assert all(own[0] == 0 and own[-1] == 200 for own in steps)
    assert gaps.min() == 1
    assert gaps.max() == 10
    # geometric: every gap is rarer than the one before
    assert (np.diff(np.bincount(gaps.ravel())[1:]) < 0).all()
    assert len({tuple(own) for own in steps}) == 300


def test_a_log_holds_states_times_and_the_actions_applied_there(unseen):
    steps = [np.arange(0, 25, 4)] * 4
    log, grid = _uneven_logs.logged_at(unseen, steps), unseen.decimate(4)
    for field in ("states", "actions", "params", "times"):
        np.testing.assert_array_equal(getattr(log, field), getattr(grid, field))
    assert log.names == grid.names


def test_every_log_but_the_full_one_has_as_many_states(small):
    train, _ = _tasks.episodes("cartpole", 0)
    logs = {log: _uneven_logs.thinned(train, log, 4, 0) for log in ("irregular", "regular", "full")}
    assert len(logs["irregular"].states) == len(logs["regular"].states) == 6 * 7
    assert logs["full"] is train
    assert len(np.unique(np.diff(logs["irregular"][0].times).round(6))) > 1
    again = _uneven_logs.thinned(train, "irregular", 4, 1)
    assert not np.array_equal(again.times, logs["irregular"].times)


def test_irregular_times_of_the_test_are_not_those_of_the_log(small):
    train, _ = _tasks.episodes("cartpole", 0)
    log = _uneven_logs.thinned(train, "irregular", 4, 0)
    asked = _uneven_logs.asked_steps(6, 24, 4, 0)
    assert list(asked) == ASKED
    logged = [tuple((episode.times / 0.02).round().astype(int)) for episode in log]
    assert [tuple(own) for own in asked["irregular"]] != logged
    assert [len(asked[name][0]) for name in ASKED] == [25, 7, 13, 7]


# -- predictions --------------------------------------------------------------------------


def test_predictions_stand_at_the_steps_asked_for(unseen):
    steps = [np.array([0, 3, 4, 24]), np.array([0, 1, 23, 24]), *[np.array([0, 5, 6, 7])] * 2]
    path = _uneven_logs.predicted(StepCounter(), unseen, steps, "none")
    np.testing.assert_array_equal(path[:, 0], unseen.states[::25])
    for whole, own in zip(path, steps, strict=True):
        np.testing.assert_array_equal(np.flatnonzero(~np.isnan(whole[:, 0])), own)
        np.testing.assert_array_equal(whole[own[1:], 0], [1, 2, 3])
    kept = _uneven_logs.only_at(path, [np.array([0, 24])] * 4)
    np.testing.assert_array_equal(np.isfinite(kept[0, :, 0]), np.isin(np.arange(25), [0, 24]))


def test_long_steps_are_as_few_as_can_be(unseen):
    path = _uneven_logs.with_long_steps(StepCounter(), unseen, 4, "none")
    count = np.ceil(np.arange(1, 25) / 4)
    np.testing.assert_array_equal(path[:, 1:], np.broadcast_to(count[:, None], (4, 24, 4)))


def test_long_and_short_steps_of_an_exact_model_arrive_at_the_truth():
    # s' = 2, in uneven steps
    times = [np.r_[0, np.cumsum(gaps)] * 0.1 for gaps in ([1, 3, 2, 2], [4, 1, 1, 2])]
    log = TrajectoryDataset.from_arrays([2 * own[:, None] for own in times], times=times)
    model = OneStepRegressor(LinearRegression(), inputs=["state", "dt"]).fit(log)
    grid = np.arange(9) * 0.1
    test = TrajectoryDataset.from_arrays(
        [1 + 2 * grid[:, None]] * 2, actions=np.zeros((2, 8, 1)), times=[grid] * 2
    )
    truth = test.states.reshape(2, 9, 1)
    long = _uneven_logs.with_long_steps(model, test, 4, "none")
    np.testing.assert_allclose(long, truth)
    short = _uneven_logs.predicted(model, test, [np.arange(9)] * 2, "none")
    np.testing.assert_allclose(short, truth)


def test_straight_lines_join_grid_times_and_keep_divergence_to_itself():
    rng = np.random.default_rng(0)
    path = rng.normal(size=(3, 13, 2))
    lines = _uneven_logs.straight_lines(path, 4)
    for i, j in np.ndindex(3, 2):
        expected = np.interp(np.arange(13), np.arange(0, 13, 4), path[i, ::4, j])
        np.testing.assert_allclose(lines[i, :, j], expected)
    path[0, 8:] = np.inf
    lines = _uneven_logs.straight_lines(path, 4)
    np.testing.assert_array_equal(np.isinf(lines[0, :, 0]), np.arange(13) > 4)
    assert np.isfinite(lines[1:]).all()


def test_a_cubic_is_exact_for_a_cubic():
    at = np.arange(17.0)
    path = (0.1 * at**3 - at**2)[None, :, None]
    np.testing.assert_allclose(_uneven_logs.cubic(path, 4), path, atol=1e-9)


def test_trajectory_models_answer_alike_whatever_else_is_asked(small, unseen):
    train, _ = _tasks.episodes("cartpole", 0)
    log = _uneven_logs.thinned(train, "irregular", 4, 0)
    model = TrajectoryRegressor(random_state=0).set_params(estimator__max_steps=20).fit(log)
    asked = _uneven_logs.asked_steps(4, 24, 4, 0)
    whole = _uneven_logs.predicted(model, unseen, asked["every step"], "none")
    for steps in asked.values():
        some = _uneven_logs.predicted(model, unseen, steps, "none")
        np.testing.assert_array_equal(some, _uneven_logs.only_at(whole, steps))


# -- errors -------------------------------------------------------------------------------


def test_errors_by_distance_are_those_of_the_steps_at_that_distance():
    errors = np.arange(1.0, 33)[None]
    found = _uneven_logs.by_distance(errors, 4)
    by_hand = {
        "interval 1:1": [1, 3],
        "interval 1:2": [2],
        "intervals 2 to 5:0": [4, 8, 12, 16],
        "intervals 2 to 5:1": [5, 7, 9, 11, 13, 15, 17, 19],
        "intervals 2 to 5:2": [6, 10, 14, 18],
        "later:0": [20, 24, 28, 32],
        "later:1": [21, 23, 25, 27, 29, 31],
        "later:2": [22, 26, 30],
    }
    assert {name: float(value[0]) for name, value in found.items()} == {
        name: pytest.approx(np.mean(steps)) for name, steps in by_hand.items()
    }


def test_true_states_err_only_between_grid_times(small):
    linear, cubic = _uneven_logs.cell("cartpole", "true states", "paper", "regular", 4, "quick", 0)
    for some in (linear, cubic):
        errors = dict(zip(some["asked"]["of"], some["asked"]["median"], strict=True))
        assert errors["grid"] == 0 < errors["every step"]
    _, test = _tasks.episodes("cartpole", 0, n_test=4)
    train, _ = _tasks.episodes("cartpole", 0)
    width = np.ptp(train.states, axis=0)
    at, by_episode = np.arange(25), []
    for episode in test:
        s = episode.states
        lines = np.stack([np.interp(at, at[::4], s[::4, j]) for j in range(4)], axis=1)
        by_episode.append((((lines - s) / width) ** 2)[1:].mean())
    assert linear["asked"]["median"][0] == pytest.approx(np.median(by_episode))


@pytest.mark.parametrize(
    ("system", "expected"),
    [
        (System("T", "default", "regular"), {("none", "direct"), ("none", "linear")}),
        (System("C with dt", "default", "irregular"), {("none", "direct"), ("none", "long steps")}),
        (System("D", "default", "regular"), {("policy", "linear"), ("logged", "linear")}),
        (System("D", "default", "full"), {("policy", "direct"), ("logged", "direct")}),
    ],
    ids=["T", "C with dt", "D of a regular log", "D of the full log"],
)
def test_what_each_system_can_do(small, system, expected):
    results = _uneven_logs.cell("cartpole", *system, 4, "quick", 0)
    assert {(some["actions"], some["way"]) for some in results} == expected
    for some in results:
        assert some["asked"]["of"] == ASKED
        assert len(some["curve"]["median"]) == 6


# -- the whole ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Tables of one run of everything."""
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        out = tmp_path_factory.mktemp("results")
        arguments = ["--quick", "--n-jobs", "1", "--out", str(out)]
        continuous_time.BENCHMARK.main(arguments)
    return out / "continuous-time"


def _tables(folder):
    return {name: pd.read_csv(folder / f"{name}.csv") for name in ("asked", "curves", "distances")}


def test_everything_comes_out_and_the_text_needs_only_the_tables(finished):
    for stem in ("continuous-time", "continuous-time-asked", "continuous-time-distance"):
        assert (finished / f"{stem}.png").stat().st_size > 4_000
    asked = _tables(finished)["asked"]
    assert set(asked["log"]) == {"irregular", "regular", "full"}
    assert {"T", "T (ours)", "C with dt (ours)", "D (ours)", "true states"} <= set(asked["model"])
    text = (finished / "continuous-time.md").read_text()
    assert "cartpole, 0.08 s" in text
    assert continuous_time.report(_tables(finished)).rstrip() + "\n" == text


@pytest.mark.parametrize(("factor", "word"), [(1e-6, "wins"), (1e6, "loses")])
def test_the_verdict_follows_the_tables(finished, factor, word):
    tables = _tables(finished)
    ours = tables["asked"]["model"] == "T (ours)"
    tables["asked"].loc[ours, "median"] *= factor
    text = continuous_time.report(tables)
    [line] = [line for line in text.splitlines() if line.startswith(f"- T (ours) {word}: ")]
    assert line.count("log, all") == line.count("log, those that know no policy") == 2


def test_a_loss_between_grid_times_is_seen(finished):
    tables = _tables(finished)
    places = tables["distances"]
    of_grid = (places["log"] == "regular") & (places["model"] == "T (ours)")
    between = of_grid & (places["way"] == "direct") & (places["distance"] > 0)
    for factor, word in ((1e3, "something"), (1e-3, "less than nothing")):
        changed = places.assign(median=places["median"].where(~between, places["median"] * factor))
        text = continuous_time.report(tables | {"distances": changed})
        assert f"- T (ours), cartpole, 0.08 s: {word}, " in text


def test_words_need_all_seeds():
    ratio = continuous_time.Ratio.of(pd.Series([2.0, 3.0]), pd.Series([1.0, 4.0]))
    assert str(ratio) == "1.4 (0.75 to 2)"
    assert ratio.word("wins", "draws", "loses") == "draws"
    both = continuous_time.Ratio.of(pd.Series([2.0, np.inf]), pd.Series([1.0, np.inf]))
    assert np.isnan(both.middle)
    assert both.word("wins", "draws", "loses") == "draws"
    assert continuous_time.Ratio(2.0, 1.2, 3.0).word("wins", "draws", "loses") == "loses"
    assert continuous_time.Ratio(0.5, 0.2, 0.8).word("wins", "draws", "loses") == "wins"
    assert continuous_time.Ratio(1.0, 0.95, 1.05).word("wins", "draws", "loses") == "draws"


def test_diverged_forecasts_are_counted_and_stay_infinite(finished):
    tables = _tables(finished)
    asked = tables["asked"]
    line = (asked["model"] == "D (ours)") & (asked["log"] == "full") & (asked["way"] == "direct")
    asked.loc[line, ["median", "n_diverged"]] = [np.inf, 3]
    text = continuous_time.report(tables)
    assert "| full | D (ours) | policy | direct | inf +3 |" in text
