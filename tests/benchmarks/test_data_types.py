"""Kinds of cartpole data: how episodes are kept, one scale a test set, the whole benchmark."""

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LinearRegression

from benchmarks._results import write_csv
from benchmarks.paper import _kinds, _models, data_types
from benchmarks.paper._command import Run
from trajlearn import Cartpole, OneStepRegressor, TrajectoryRegressor


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_kinds, "LENGTH", 30)
    monkeypatch.setattr(data_types, "LENGTH", 30)
    monkeypatch.setattr(data_types, "N_EPISODES", 8)
    monkeypatch.setattr(data_types, "N_TEST", {"quick": 6})
    windows = {"short": slice(2, 10), "long": slice(20, 30)}
    monkeypatch.setattr(_kinds, "WINDOWS", windows)
    monkeypatch.setattr(data_types, "WINDOWS", windows)
    monkeypatch.setattr(_models, "QUICK_STEPS", 20)
    monkeypatch.setattr(_models, "QUICK_EPOCHS", {"T": 1, "one-step": 1})


def test_unstable_episodes_are_all_there_and_ended_ones_are_their_beginnings(small):
    whole, _ = _kinds.episodes("unstable", 0, 20, 1)
    ended, _ = _kinds.episodes("ended", 0, 20, 1)
    assert (whole.lengths == 30).all()
    assert not whole.terminated.any()
    assert ended.lengths.min() < 30
    outside = Cartpole().is_terminal
    for full, part in zip(whole, ended, strict=True):
        np.testing.assert_array_equal(full.states[: part.length + 1], part.states)
        assert not outside(part.states[1:-1]).any()
        assert outside(part.states[-1]) == (part.length < 30)


def test_survivors_stay_within_the_limits(small):
    survivors, _ = _kinds.episodes("survivors", 0, 10, 1)
    assert (survivors.lengths == 30).all()
    assert not Cartpole().is_terminal(survivors.states).any()
    # the gains are those of unstable data: of either sign
    assert (survivors.params > 0).any()
    assert (survivors.params < 0).any()


def test_no_start_is_in_training_and_in_test(small):
    train, test = set(), set()
    for kind in _kinds.KINDS:
        for seed in (0, 1, 2):
            for starts, ds in zip((train, test), _kinds.episodes(kind, seed, 6, 6), strict=True):
                starts |= {tuple(episode.states[0]) for episode in ds}
    assert train
    assert test
    assert not train & test


@pytest.mark.parametrize("actions", ["logged", "policy"])
def test_errors_are_in_units_of_the_given_range(small, actions):
    train, _ = _kinds.episodes("stable", 0, 8, 1)
    _, test = _kinds.episodes("ended", 0, 1, 6)
    model = OneStepRegressor(LinearRegression(), policy=Cartpole().policy).fit(train)
    scale = np.array([[-1.0, -2.0, -3.0, -4.0], [1.0, 2.0, 5.0, 4.0]])
    errors = _kinds.errors_of(model, test, scale, actions=actions)
    mean = model.predict(test, actions=actions).mean
    for i, episode in enumerate(test):
        off = (mean[i, : episode.length] - episode.states[1:]) / [2.0, 4.0, 8.0, 8.0]
        row = errors.iloc[i].to_numpy()
        np.testing.assert_allclose(row[: episode.length], (off**2).mean(axis=1))
        assert np.isnan(row[episode.length :]).all()


def test_a_diverged_forecast_is_an_infinite_error(small):
    _, test = _kinds.episodes("stable", 0, 1, 6)
    fitted = TrajectoryRegressor(LinearRegression(), random_state=0).fit(test)

    class Diverging:
        def predict(self, ds):
            forecast = fitted.predict(ds)
            forecast.diverged_at[1] = 4
            return forecast

    errors = _kinds.errors_of(Diverging(), test, _kinds.state_range(test)).to_numpy()
    assert np.isinf(errors[1, 3:]).all()
    assert np.isfinite(errors[1, :3]).all()
    assert np.isfinite(errors[[0, 2, 3, 4, 5]]).all()


def test_windows_count_the_episodes_that_have_steps(small):
    errors = pd.DataFrame(np.full((4, 30), np.nan), columns=range(1, 31))
    errors.iloc[0] = 1.0
    errors.iloc[1] = 3.0
    errors.iloc[1, 25:] = np.inf
    errors.iloc[2, :5] = [9.0, 9.0, 5.0, 6.0, 7.0]
    errors.iloc[3, :2] = 0.0
    windows = _kinds.assess(errors)["windows"]
    assert windows["n_episodes"] == 4
    assert windows["n_diverged"] == 1
    assert windows["n_short"] == 3
    assert windows["short"] == 3.0
    assert windows["n_long"] == 2
    assert windows["long"] == np.inf
    curve = _kinds.assess(errors)["curve"]
    assert curve["horizon"][-1] == 30
    assert curve["n_episodes"][:2] == [4, 4]
    assert curve["n_episodes"][-1] == 2
    assert curve["n_diverged"][-1] == 1


def test_holding_the_start_state(small):
    _, test = _kinds.episodes("ended", 0, 1, 6)
    scale = _kinds.state_range(test)
    errors = _kinds.errors_of_holding(test, scale).to_numpy()
    i = int(np.argmax(test.lengths))
    off = (test[i].states[3] - test[i].states[0]) / np.ptp(test.states, axis=0)
    assert errors[i, 2] == pytest.approx((off**2).mean())
    assert ((~np.isnan(errors)).sum(axis=1) == test.lengths).all()


def test_swings_count_changes_of_side_beyond_the_threshold():
    t = np.linspace(0, 4 * np.pi, 200)
    assert _kinds.swings(0.1 * np.sin(t))
    assert not _kinds.swings(0.005 * np.sin(t))
    assert not _kinds.swings(0.1 * np.exp(-t) * np.sin(t / 4))


def pairs_of(d_logged, d_policy, t, held=1.0):
    """A table in which every pair of kinds has the same errors, one a seed."""
    lines = []
    errors = {("D", "logged"): d_logged, ("D", "policy"): d_policy, ("T", "none"): t}
    for tested in data_types.kinds("unstable"):
        trained_on = {key: data_types.kinds("unstable") for key in errors}
        trained_on[data_types.HELD, "none"] = ["-"]
        for key, some in (errors | {(data_types.HELD, "none"): [held] * len(t)}).items():
            for trained in trained_on[key]:
                for seed, value in enumerate(some):
                    line = {"trained": trained, "tested": tested, "model": key[0]}
                    line |= {"actions": key[1], "seed": seed, "long": value}
                    lines.append(line | {"n_episodes": 5, "n_diverged": int(np.isinf(value))})
    return pd.DataFrame(lines)


def test_ratios_are_taken_seed_by_seed():
    pairs = pairs_of([2.0, np.inf, 30.0], [1.0, 1.0, 1.0], [1.0, 10.0, 2.0])
    table = data_types.ratios(pairs, data_types.kinds("unstable"), "", "long")
    assert len(table) == 9
    line = table.iloc[4]
    assert (line["trained on"], line["tested on"]) == ("unstable", "unstable")
    assert line["D, logged"] == "30 (2 to inf); 1 of 15 diverge"
    assert line["D, logged / T"] == "15 (2 to inf)"
    assert line["D, recomputed / T"] == "0.5 (0.1 to 1)"
    assert line[data_types.HELD].startswith("1 ")


def test_pairs_in_which_a_model_is_worse_are_counted():
    pairs = pairs_of([3.0], [0.5], [0.8])
    better = (
        (pairs["model"] == "D") & (pairs["trained"] == "stable") & (pairs["tested"] == "stable")
    )
    pairs.loc[better, "long"] = 0.1
    text = data_types.count_worse(pairs, data_types.kinds("unstable"), "", "long")
    assert "logged actions is worse than T in 8, with recomputed actions in 0" in text
    assert "D, logged, in 8; D, recomputed, in 0; T in 0" in text


def test_the_whole_benchmark(small, tmp_path, monkeypatch):
    # without the kind that takes longest to draw
    monkeypatch.delitem(data_types.KINDS, "survivors")
    monkeypatch.delitem(data_types.WAYS, "survivors")
    run = Run("data-types", "quick", [0], tmp_path, 1, {})
    tables = {}
    for stem, table in data_types.run(run).items():
        write_csv(tmp_path / f"{stem}.csv", table)
        tables[stem] = pd.read_csv(tmp_path / f"{stem}.csv")
    pairs = tables["pairs"]
    fitted = pairs[pairs["model"] != data_types.HELD]
    # 4 kinds times 4, D twice for its two sources of actions, paper's and ours
    assert len(fitted) == 16 * 6
    assert (pairs["model"] == data_types.HELD).sum() == 4
    assert set(data_types.reach(tables)["ended"]) - {0, 6}
    text = data_types.report(tables)
    assert text.count("| unstable | stable |") == 2
    assert "Of 6 unstable test episodes, 6 have steps at horizons 21 to 30" in text
    figures = data_types.draw(tables)
    assert sorted(figures) == [
        "data-types-ended",
        "data-types-reach",
        "data-types-unstable",
    ]
    titles = [ax.get_title(loc="left") for ax in figures["data-types-ended"].axes]
    assert titles[:3] == ["an episode: stable", "an episode: ended", "an episode: periodic"]
    assert titles[4] == "trained on ended, tested on stable"
    # a median of few episodes is not drawn
    shown = figures["data-types-ended"].axes[7].get_xlim()[1]
    counts = data_types.reach(tables)["ended"]
    assert shown == counts.index[counts >= data_types.MIN_EPISODES].max()
