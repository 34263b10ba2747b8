"""Logged against recomputed actions, on errors that are known."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import action_source
from benchmarks.paper._rollouts import shown_horizons
from benchmarks.paper._tasks import TASKS

INF = np.inf
SEEDS, N_EPISODES = (0, 1, 2), 20
#: Error with logged actions / with recomputed ones, by model and window.
FACTOR = {
    "PE": {"short": 0.5, "long": 4.0, "beyond": INF},
    "D (ours)": {"short": 1.0, "long": 0.1, "beyond": 2.0},
}


def fake_measure(run, tasks, models):
    rng = np.random.default_rng(0)
    curves, episodes = [], []
    for task in tasks:
        horizons = shown_horizons(TASKS[task].test_length)
        for model, factor in FACTOR.items():
            for seed in SEEDS:
                key = {"task": task, "model": model, "seed": seed}
                hard = rng.lognormal(size=N_EPISODES)
                for actions in ("logged", "policy"):
                    lines = {"episode": range(N_EPISODES), "within": 0.0, "reward": 0.0}
                    for window, ratio in factor.items():
                        lines[window] = hard * (ratio if actions == "logged" else 1.0)
                    episodes.append(pd.DataFrame(key | {"actions": actions} | lines))
                    # logged actions are ahead up to horizon 7
                    ahead = np.where(horizons <= 7, 0.5, 2.0) if actions == "logged" else 1.0
                    columns = ("median", "mean", "q65", "q95")
                    curve = {"horizon": horizons} | dict.fromkeys(columns, ahead)
                    curves.append(pd.DataFrame(key | {"actions": actions, "n_diverged": 0} | curve))
    return {"curves": pd.concat(curves), "episodes": pd.concat(episodes)}


def test_ratios_are_paired_by_episode_and_seed():
    # shuffled lines: the pairing goes by seed and episode, not by position
    episodes = fake_measure(None, ["cartpole"], None)["episodes"].sample(frac=1, random_state=0)
    ratios = action_source.ratios(episodes).set_index(["model", "window"])
    for model, factor in FACTOR.items():
        for window, expected in factor.items():
            line = ratios.loc[(model, window)]
            for column in ("estimate", "low", "high", "least_seed", "greatest_seed"):
                assert line[column] == pytest.approx(expected), (model, window, column)


def test_the_whole_command_says_which_source_is_better_and_where(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(action_source, "measure", fake_measure)
    action_source.BENCHMARK.main(["--quick", "--n-jobs", "1", "--out", str(tmp_path)])
    assert (tmp_path / "action-source" / "action-source.png").stat().st_size > 4_000
    printed = capsys.readouterr().out
    assert (
        "- cartpole, PE: recomputed actions are better at long and beyond horizons; logged actions "
        "are better at short horizons." in printed
    )
    assert (
        "- reacher, D (ours): recomputed actions are better at beyond horizons; logged actions are "
        "better at long horizons; the difference may be chance at short horizons." in printed
    )
    # ahead for the last time
    assert printed.count("smaller median is 7 (7 to 7); 0 means none.") == 4


def test_seeds_that_disagree_leave_it_open():
    ratios = pd.DataFrame(
        {"model": "PE", "window": ["long"], "estimate": 3.0, "low": 2.0, "high": 4.0}
        | {"least_seed": 0.9, "greatest_seed": 5.0}
    )
    (line,) = action_source.findings(ratios, "cartpole")
    assert line == "- cartpole, PE: the difference may be chance at long horizons."
