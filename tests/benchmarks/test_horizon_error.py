"""Error by horizon: what the tables and sentences say, and what the figures show."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _tasks, horizon_error
from benchmarks.paper._command import Run
from benchmarks.paper._models import build, label
from benchmarks.paper._rollouts import action_sources, shown_horizons, windows

INF = np.inf


def lines_of(model, actions, by_seed, **others):
    """Lines of a table of episodes: the same errors in every window unless told otherwise."""
    lines = []
    for seed, errors in enumerate(by_seed):
        for episode, error in enumerate(errors):
            line = {"task": "cartpole", "model": model, "actions": actions, "seed": seed}
            line |= dict.fromkeys(horizon_error.WINDOWS, error) | {"episode": episode}
            lines.append(
                line | {window: values[seed][episode] for window, values in others.items()}
            )
    return pd.DataFrame(lines)


def test_titles_are_the_horizons_that_the_cells_average():
    titles = horizon_error.window_titles("cartpole")
    length, test_length = _tasks.TASKS["cartpole"]
    steps = np.arange(1, test_length + 1)
    for window, title in titles.items():
        covered = steps[windows(length)[window]]
        assert title == f"{window}, {covered.min()}-{covered.max()}"


def test_the_table_has_median_spread_and_divergence():
    beyond = [[1.0, INF, INF], [1.0, 2.0, INF]]
    episodes = lines_of("D", "logged", [[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]], beyond=beyond)
    (line,) = horizon_error.summary(episodes, "cartpole").to_dict("records")
    short, _, beyond = horizon_error.window_titles("cartpole").values()
    assert line[short] == "3 (2 to 4)"
    assert line[beyond] == "inf (2 to inf)"
    assert line["diverged"] == "3 of 6"


def test_the_best_model_comes_first_and_the_others_in_its_multiples():
    good = np.linspace(1, 2, 30)
    episodes = pd.concat(
        [
            lines_of("T", "none", [10 * good], short=[100 * good]),
            lines_of("D", "logged", [good], beyond=[np.full(30, INF)]),
        ]
    )
    short, long, beyond = horizon_error.best(episodes, "cartpole")
    assert "best is D, 1.5. Times its error: T 100 (100 to 100)." in short
    assert "best is D, 1.5. Times its error: T 10 (10 to 10)." in long
    assert "best is T, 15. Times its error: D diverges." in beyond


def test_a_difference_that_may_be_chance_is_said_to_be():
    rng = np.random.default_rng(0)
    episodes = pd.concat([lines_of(model, "none", [rng.uniform(size=30)]) for model in "TD"])
    assert "not told apart" in horizon_error.best(episodes, "cartpole")[0]


def test_where_all_diverge_nobody_is_best():
    episodes = pd.concat([lines_of(model, "none", [[INF, INF]]) for model in "TD"])
    assert horizon_error.best(episodes, "cartpole")[0].endswith("every model diverges.")


def test_among_many_the_runner_up_and_all_trajectory_models_are_named():
    names = ["D", "PE", "C (ours)", "LSTM", "T", "T (ours)"]
    episodes = pd.concat(
        [lines_of(name, "none", [[float(i)] * 3]) for i, name in enumerate(names, start=1)]
    )
    line = horizon_error.best(episodes, "cartpole")[0]
    said = [name for name in names if f"{name} " in line.split("Times its error: ")[1]]
    assert said == ["PE", "T", "T (ours)"]


def fake_measure(run, tasks, models):
    """Tables as from `measure`, of models whose errors do not depend on anything."""
    rng = np.random.default_rng(0)
    curves, episodes = [], []
    for task in tasks:
        horizon = shown_horizons(_tasks.TASKS[task].test_length)
        for model, settings in models:
            for actions in action_sources(model):
                key = {"task": task, "model": label(model, settings), "actions": actions, "seed": 0}
                errors = {c: rng.lognormal(size=len(horizon)) for c in ("median", "q65", "q95")}
                curve = {"horizon": horizon, "mean": np.inf, "n_diverged": 1} | errors
                curves.append(pd.DataFrame(key | curve))
                some = {"episode": range(9), "reward": 0.0} | {
                    window: rng.lognormal(size=9) for window in ("within", *horizon_error.WINDOWS)
                }
                episodes.append(pd.DataFrame(key | some))
    return {"curves": pd.concat(curves), "episodes": pd.concat(episodes)}


def test_tables_and_text_have_every_model(monkeypatch, tmp_path):
    monkeypatch.setattr(horizon_error, "measure", fake_measure)
    tables = horizon_error.run(Run("horizon-error", "quick", [0], tmp_path, 1, {}))
    paper = {"D", "PE", "LSTM", "T"}
    ours = {f"{model} (ours)" for model in ("T", "T, features", "C", "D", "LSTM")}
    text = horizon_error.report(tables)
    for task, some in tables["episodes"].groupby("task"):
        assert set(some["model"]) == paper | ours
        assert set(some.loc[some["model"] == "D", "actions"]) == {"logged", "policy"}
        assert f"### {task}" in text
    sentences = [line for line in text.splitlines() if "best is" in line]
    # for each task first the paper's comparison, then the one without the oracle: three windows
    assert len(sentences) == 2 * 2 * 3
    for i in (0, 1, 2, 6, 7, 8):
        assert {name in sentences[i] for name in ("D, logged", "PE, logged", "T")} == {True}
        assert "recomputed" not in sentences[i]
        assert "(ours)" not in sentences[i]
    for i in (3, 4, 5, 9, 10, 11):
        assert {name in sentences[i] for name in ("T (ours)", "T, features (ours)")} == {True}
        assert "logged" not in sentences[i]


def test_figures_show_what_their_names_say():
    curves = fake_measure(
        None,
        ["cartpole", "reacher"],
        [(m, "paper") for m in horizon_error.PAPER] + [(m, "default") for m in horizon_error.OURS],
    )["curves"]
    figures = horizon_error.draw({"curves": curves})
    shown = {
        stem: [text.get_text() for text in figure.legends[0].get_texts()]
        for stem, figure in figures.items()
    }
    assert shown["horizon-error-paper"] == ["D, logged", "PE, logged", "LSTM, logged", "T"]
    assert set(shown["horizon-error-ours"]) == {
        "T (paper)",
        "T (ours)",
        "T, features (ours)",
        "C (ours)",
        "D (ours), recomputed",
        "LSTM (ours), recomputed",
    }
    for figure in figures.values():
        scales = [ax.get_xscale() for ax in figure.axes]
        assert scales == ["linear", "linear", "log", "log"]
        # the training length is marked in every panel
        for ax, length in zip(figure.axes, (200, 500, 200, 500)):
            assert any(list(line.get_xdata()) == [length, length] for line in ax.lines)


@pytest.mark.parametrize("task", ["cartpole", "reacher"])
def test_every_model_can_be_built(task):
    policy = _tasks.environment(task).policy
    for names, settings in ((horizon_error.PAPER, "paper"), (horizon_error.OURS, "default")):
        for name in names:
            for mode in ("quick", "full"):
                assert build(name, settings, policy=policy, mode=mode, seed=0).random_state == 0
