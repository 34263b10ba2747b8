"""Error by horizon: what the tables and sentences say, and what the figures show."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _noise_floor, _tasks, _trefoil, horizon_error
from benchmarks.paper._command import Run
from benchmarks.paper._models import build, label
from benchmarks.paper._rollouts import N_TEST, action_sources, shown_horizons, windows

INF = np.inf


@pytest.fixture(autouse=True)
def _no_figure_stays_open():
    yield
    plt.close("all")


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
        horizon = shown_horizons(_tasks.shape(task).test_length)
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


def fake_exact(task, mode, seed):
    """Errors of the exact plant, better than those of all models."""
    horizon = shown_horizons(_tasks.shape(task).test_length)
    curve = dict.fromkeys(("median", "q65", "q95"), [1e-3] * len(horizon))
    errors = dict.fromkeys(("within", *horizon_error.WINDOWS), [1e-3] * 9)
    curve |= {"horizon": horizon.tolist(), "n_diverged": [0] * len(horizon)}
    return {"curve": curve, "windows": errors}


@pytest.fixture
def tables(monkeypatch, tmp_path):
    """Tables of a run in which nothing is trained, without real flights."""
    monkeypatch.setattr(horizon_error, "measure", fake_measure)
    monkeypatch.setattr(horizon_error, "exact_cell", fake_exact)
    monkeypatch.setattr(_trefoil, "flights", no_flights)
    return horizon_error.run(Run("horizon-error", "quick", [0], tmp_path, 1, {}))


def no_flights():
    raise OSError("no network")


def test_tables_and_text_have_every_model(tables):
    paper = {"D", "PE", "LSTM", "T"}
    ours = {f"{model} (ours)" for model in ("T", "T, features", "C", "D", "LSTM")}
    text = horizon_error.report(tables)
    for task, some in tables["episodes"].groupby("task"):
        assert set(some["model"]) == paper | ours
        assert set(some.loc[some["model"] == "D", "actions"]) == {"logged", "policy"}
        assert f"### {task}" in text
    (task,) = tables["quadrotor-episodes"]["task"].unique()
    of_quadrotor = {*paper, *ours, "exact plant"} - {"T, features (ours)"}
    assert set(tables["quadrotor-episodes"]["model"]) == of_quadrotor
    assert f"### {task}" in text
    sentences = [line for line in text.splitlines() if "best is" in line]
    # for each task first the paper's comparison, then the one without the oracle: three windows
    assert len(sentences) == 3 * 2 * 3
    for i in (0, 1, 2, 6, 7, 8, 12, 13, 14):
        assert {name in sentences[i] for name in ("D, logged", "PE, logged", "T")} == {True}
        assert "recomputed" not in sentences[i]
        assert "(ours)" not in sentences[i]
    for i in (3, 4, 5, 9, 10, 11, 15, 16, 17):
        assert "T (ours)" in sentences[i]
        assert ("T, features (ours)" in sentences[i]) == (i < 12)
        assert "logged" not in sentences[i]
    # what knows the equations is no model
    assert not any("exact plant" in line for line in sentences)
    assert "The exact plant is the simulator without its noise" in text


def test_other_benchmarks_keep_their_two_tasks(tables):
    assert list(_tasks.TASKS) == ["cartpole", "reacher"]
    assert set(tables["episodes"]["task"]) == set(_tasks.TASKS)
    assert set(tables["curves"]["task"]) == set(_tasks.TASKS)


def test_without_flights_the_text_says_how_to_get_them(tables, capsys):
    assert not any(stem.startswith("real") for stem in tables)
    text = horizon_error.report(tables)
    assert "### quadrotor-real" in text
    assert "`--data FOLDER` names the folder that holds `nanobench_trefoil`" in text
    assert "horizon-error-quadrotor-real" not in horizon_error.draw(tables)


@pytest.mark.parametrize(
    ("times", "verdict"),
    [(20.0, "holds"), (3.0, "better, by less"), (0.2, "T is worse"), (1.0, "not told apart")],
)
def test_the_paper_s_claim_is_judged(times, verdict):
    good = np.linspace(1, 2, 30)
    both = [lines_of("T", "none", [good]), lines_of("D", "logged", [times * good])]
    episodes = pd.concat(both).assign(task="quadrotor-sim")
    said = horizon_error.judged(episodes, "quadrotor-sim")
    assert f"D, long, 51-500: {verdict}" in said
    assert f"D, beyond, 501-1000: {verdict}" in said


def test_nothing_is_better_than_the_exact_plant_without_noise(monkeypatch):
    """Where there is no noise, its errors are zero; with noise they are not."""
    monkeypatch.setitem(_tasks.QUADROTOR, "quadrotor-sim", _tasks.Task(60, 90))
    monkeypatch.setitem(N_TEST, "quick", 3)
    monkeypatch.setattr(_tasks, "N_EPISODES", 3)
    noisy = _noise_floor.cell("quadrotor-sim", "quick", 0)
    assert np.min(noisy["windows"]["beyond"]) > 1e-4
    assert len(noisy["curve"]["horizon"]) == len(noisy["curve"]["q95"])
    env = _tasks.environment("quadrotor-sim")
    calm = _noise_floor.replace(env, noise=0.0)
    for module in (_tasks, _noise_floor):
        monkeypatch.setattr(module, "environment", lambda task: calm)
    exact = _noise_floor.cell("quadrotor-sim", "quick", 0)
    assert np.max(exact["windows"]["beyond"]) < 1e-20


def test_only_a_plant_with_noise_has_a_floor():
    with pytest.raises(ValueError, match="reacher has no process noise"):
        _noise_floor.cell("reacher", "quick", 0)


def test_figures_show_what_their_names_say(tables):
    figures = horizon_error.draw(tables)
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
        "exact plant",
    }
    for figure in figures.values():
        scales = [ax.get_xscale() for ax in figure.axes]
        assert scales == ["linear"] * 3 + ["log"] * 3
        # the training length is marked in every panel
        for ax, length in zip(figure.axes, (200, 500, 500) * 2):
            assert any(list(line.get_xdata()) == [length, length] for line in ax.lines)


@pytest.mark.parametrize("task", ["cartpole", "reacher", "quadrotor-sim"])
def test_every_model_can_be_built(task):
    policy = _tasks.environment(task).policy
    for names, settings in ((horizon_error.PAPER, "paper"), (horizon_error.OURS, "default")):
        for name in names:
            if (task, name) == ("quadrotor-sim", "T, features"):
                continue
            for mode in ("quick", "full"):
                assert build(name, settings, policy=policy, mode=mode, seed=0).random_state == 0
