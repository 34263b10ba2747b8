"""Iterative learning on a few short trials, its tables on made-up ones, and its tasks."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _control_tasks, _iterative_methods, iterative_learning
from benchmarks.paper._control_tasks import CONTROL_TASKS, PAPER_START, normalised
from benchmarks.paper._iterative_figures import draw
from benchmarks.paper._iterative_methods import (
    BO,
    BO_LATER,
    DISTILLED,
    METHODS,
    N_SOBOL,
    OF_TASK,
    RANDOM,
    repeat,
)
from benchmarks.paper._iterative_page import report
from benchmarks.paper._iterative_tables import (
    behind,
    first_near,
    median_behind,
    result,
    seconds,
    spread,
)
from benchmarks.paper.iterative_learning import BENCHMARK, settings

# -- tasks ----------------------------------------------------------------------------------------


def test_the_tasks_start_where_the_paper_s_code_does():
    starts = CONTROL_TASKS["cartpole"].starts(500, np.random.default_rng(0))
    assert np.allclose(np.abs(starts).max(axis=0), [0.25, 0.05, 0.25, 0.05], rtol=0.02)
    arm = CONTROL_TASKS["reacher"].starts(3, np.random.default_rng(0))
    assert np.allclose(arm[:, :5], 1.0, atol=1e-3)
    for task in CONTROL_TASKS.values():
        assert np.array_equal(task.test_starts, task.common_starts[: len(task.test_starts)])


def test_bounds_are_factors_of_the_lqr_gain():
    task = CONTROL_TASKS["cartpole"]
    assert np.allclose(task.bounds[:, 0], 2.0 * task.env.lqr_gain)
    assert np.allclose(task.bounds[:, 1], -0.1 * task.env.lqr_gain)
    assert CONTROL_TASKS["reacher"].bounds.tolist() == [[0, 1]] * 10 + [[-1, 1]] * 5


def test_rewards_are_greatest_at_the_goal():
    upright = CONTROL_TASKS["cartpole"].reward
    assert upright(np.zeros((2, 3, 4))).tolist() == [[1.0] * 3] * 2
    assert upright(np.array([1e200, 0.0, 0.0, 0.0])) == 0.0
    arm = CONTROL_TASKS["reacher"]
    assert arm.terminal_reward < arm.floor < 0.0


def test_an_early_end_earns_nothing_afterwards():
    task = CONTROL_TASKS["cartpole"]
    # a gain of the wrong sign throws the pole over
    [value] = task.true_return(-task.env.lqr_gain[None], np.array([[0.0, 0.0, 0.2, 0.0]]))
    flown = task.env.rollout([[0.0, 0.0, 0.2, 0.0]], -task.env.lqr_gain, task.length)
    assert flown.terminated.all()
    assert value == pytest.approx(task.reward(flown[0].states[1:]).sum() / task.length)
    assert value < 0.5


def test_returns_of_many_controllers_are_those_of_each():
    task = CONTROL_TASKS["cartpole"]
    gains = np.outer([0.5, 1.0], task.env.lqr_gain)
    starts = task.starts(3, np.random.default_rng(0))
    both = task.true_return(gains, starts)
    one = [
        task.returns(task.env.rollout(start[None], gains[1], task.length))[0] for start in starts
    ]
    assert both[1] == pytest.approx(np.mean(one))
    assert both[0] != pytest.approx(both[1])


def test_the_best_known_is_better_than_guesses(monkeypatch):
    short = replace(CONTROL_TASKS["cartpole"], length=40)
    monkeypatch.setitem(CONTROL_TASKS, "cartpole", short)
    monkeypatch.setitem(_control_tasks._N_STARTS, "cartpole", 3)
    monkeypatch.setitem(_control_tasks._N_TEST, "cartpole", 3)
    monkeypatch.setitem(_control_tasks._BUDGET["quick"], "cartpole", (20, 2, 32))
    found = _control_tasks.best_known("cartpole", "quick")
    assert found["per_step"] == pytest.approx(found["test"])
    assert found["test"] >= found["centre"] > found["floor"] == 0.0
    assert found["paper_start"] == pytest.approx(short.true_return(PAPER_START)[0])
    assert found["n_evaluations"] == 20 + 2 * 32


def test_the_scale_ends_at_the_best_known():
    assert normalised(np.array([-1.0, -0.3]), -1.0, -0.3).tolist() == [0.0, 1.0]


# -- a small run ----------------------------------------------------------------------------------

TINY = {
    "steps": 10,
    "imagined": {"cartpole": 4, "reacher": 4},
    "paper_epochs": 1,
    "evaluations": {"cartpole": 8, "reacher": 8},
    "by_gradients": 8,
    "trials": {"cartpole": 3, "reacher": 2},
}


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(_iterative_methods.SIZES, "quick", TINY)
    monkeypatch.setattr(_iterative_methods, "PAPER_ROWS", 100)
    monkeypatch.setattr(_iterative_methods, "N_PLANNED", {"cartpole": 2, "reacher": 1})
    monkeypatch.setattr(_control_tasks, "_N_STARTS", {"cartpole": 2, "reacher": 1})
    monkeypatch.setattr(_control_tasks, "_N_TEST", {"cartpole": 2, "reacher": 1})
    few = dict.fromkeys(CONTROL_TASKS, (3, 1, 4))
    monkeypatch.setitem(_control_tasks._BUDGET, "quick", few)
    for name in ("cartpole", "reacher"):
        short = replace(CONTROL_TASKS[name], length=30)
        monkeypatch.setitem(CONTROL_TASKS, name, short)


def test_all_methods_share_the_first_trial_and_are_reproducible(small):
    first = {}
    for method in METHODS:
        lines = repeat("cartpole", method, 0, "quick")
        assert [line["trial"] for line in lines] == [1, 2, 3]
        first[method] = (lines[0]["seen"], lines[0]["true"])
    assert len(set(first.values())) == 1
    assert repeat("cartpole", RANDOM, 1, "quick")[0]["seen"] != first[RANDOM][0]
    once, again = (repeat("cartpole", DISTILLED, 0, "quick") for _ in range(2))
    assert [line["seen"] for line in once] == [line["seen"] for line in again]


def test_the_whole_benchmark(small, tmp_path, capsys):
    folder = tmp_path / "iterative-learning"
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    BENCHMARK.main(options)
    printed = capsys.readouterr().out
    assert "Share of the repeats" in printed
    for task in CONTROL_TASKS:
        assert list(dict.fromkeys(pd.read_csv(folder / f"{task}.csv")["method"])) == OF_TASK[task]
        facts = json.loads((folder / f"{task}.json").read_text())
        assert facts["settings"]["n_trials"] == TINY["trials"][task]
        assert (folder / f"{task}.png").stat().st_size > 0
    before = (folder / "cartpole.md").read_text()
    BENCHMARK.main([*options, "--redraw", "--task", "cartpole"])
    assert (folder / "cartpole.md").read_text() == before


def test_a_full_run_repeats_as_often_as_it_says(monkeypatch):
    asked = []

    class Run:
        task, mode, seeds = "reacher", "full", list(range(25))

        def cells(self, cells, function):
            cells = list(cells)
            asked.extend(cells)
            if function is repeat:
                return [[made(cell["method"], cell["repeat"], [0.1])] for cell in cells]
            return [{"params": [0.0], "test": 1.0, "floor": 0.0}]

    def made(method, number, values):
        return {"method": method, "repeat": number, "trial": 1, "true": values[0], "seen": 0.1}

    tables = iterative_learning.run(Run())
    assert tables["reacher"]["repeat"].nunique() == 10
    assert len(asked) == 1 + 10 * len(OF_TASK["reacher"])


def test_the_settings_name_what_was_done():
    for name, facts in settings("full").items():
        assert facts["task"] == name
        assert set(facts["methods"]) == set(OF_TASK[name])


# -- tables, text and figure ----------------------------------------------------------------------


def tables(best=1.0, floor=0.0, n_repeats=5):
    """T solves the task at trial 2 on every repeat, Bayesian optimisation at 3."""
    curves = {DISTILLED: [0.5, 0.97, 0.9], BO: [0.5, 0.6, 0.98], RANDOM: [0.5, 0.5, 0.5]}
    lines = [
        {
            "method": method,
            "repeat": number,
            "trial": k + 1,
            # the second trial is unlucky
            "seen": floor + (best - floor) * (0.5 if value == 0.6 else value - 0.1 * (k == 1)),
            "true": floor + (best - floor) * (value + 0.001 * number),
            "steps": 200,
            "seconds_fit": 1.0,
            "seconds_search": 2.0,
        }
        for method, values in curves.items()
        for number in range(n_repeats)
        for k, value in enumerate(values)
    ]
    scale = {"params": "[1.0]", "per_step": best, "test": best, "floor": floor}
    scale |= {"centre": floor + 0.92 * (best - floor), "n_evaluations": 100}
    scale |= {"paper_start": floor + 0.93 * (best - floor)}
    return {"cartpole": pd.DataFrame(lines), "cartpole-scale": pd.DataFrame([scale])}


def test_the_best_so_far_never_falls_and_its_scale_is_the_task_s():
    for some in (tables(), tables(best=-0.3, floor=-1.0)):
        of = result(some)
        values = of.by_trial(DISTILLED, "best_true")
        assert values.loc[0].to_numpy() == pytest.approx([0.5, 0.97, 0.97])
        assert values.loc[3].to_numpy() == pytest.approx([0.503, 0.973, 0.973])
        assert first_near(values) == 2
        assert first_near(of.by_trial(BO, "best_true")) == 3
        assert first_near(of.by_trial(RANDOM, "best_true")) is None


def test_what_a_user_would_keep_is_chosen_by_what_was_seen():
    of = result(tables())
    # seen: 0.5, 0.87, 0.9; the third trial looks best, and is worse than the second
    assert of.by_trial(DISTILLED, "kept").loc[0].to_numpy() == pytest.approx([0.5, 0.97, 0.9])
    # seen: 0.5, 0.5, 0.98; the first of equals is kept
    assert of.by_trial(BO, "kept").loc[0].to_numpy() == pytest.approx([0.5, 0.5, 0.98])


def test_the_best_known_is_never_less_than_the_best_seen():
    some = tables()
    some["cartpole-scale"]["test"] = 0.9
    assert result(some).best == pytest.approx(0.984)
    assert "0.984 per step, of a trial, better than what is found by CMA-ES" in report(some)
    assert "1 per step, found by CMA-ES on the simulator itself (100 controllers)" in report(
        tables()
    )


def test_time_is_that_of_proposals_that_a_model_makes():
    some = tables()
    lines = [
        {"method": BO_LATER, "repeat": number, "trial": k, "true": 0.5, "seen": 0.5, "steps": 200}
        | {"seconds_fit": 0.0, "seconds_search": 0.001 if k <= N_SOBOL else 0.2}
        for number in range(5)
        for k in range(1, N_SOBOL + 2)
    ]
    some["cartpole"] = pd.concat([some["cartpole"], pd.DataFrame(lines)], ignore_index=True)
    assert seconds(result(some), BO_LATER, "seconds_search") == 0.2
    some["cartpole"] = some["cartpole"][some["cartpole"]["trial"] <= 3]
    assert np.isnan(seconds(result(some), BO_LATER, "seconds_search"))
    assert f"| {BO_LATER} |  |  | 200 |" in report(some)
    assert seconds(result(some), BO, "seconds_search") == 2.0


def test_behind_counts_repeats_and_medians():
    of = result(tables())
    assert behind(of, DISTILLED, "best_true").tolist() == [0.0, 0.0, 1.0]
    gap = median_behind(of, DISTILLED, "best_true")
    assert gap.to_dict() == {3: pytest.approx(0.01)}
    assert behind(of, RANDOM, "best_true").tolist() == [0.0, 1.0, 1.0]


def test_percentiles_are_two_sided():
    values = pd.DataFrame({1: np.linspace(0, 1, 101)})
    low, high = spread(values, 0.66)
    assert (low[1], high[1]) == pytest.approx((0.17, 0.83))


def test_the_text_answers_yes_and_no():
    text = report(tables())
    assert (
        f"{DISTILLED}: within 5 % of the best known by trial 3 in the median: **yes** (0." in text
    )
    assert "in the median from trial 2 to 3: **no**, behind at trial 3 (by 0.01)" in text
    assert "the centre of the search box scores 0.920, and the theta at which the paper's" in text
    assert f"| {BO} | 0.502 (0.50 to 0.50) | 0.602 (0.60 to 0.60) | 0.98" in text
    assert "| random |" in text
    assert "0 is an arm that stays" in report(reacher())


def reacher():
    some = tables(best=-0.3, floor=-1.0)
    scale = some["cartpole-scale"].drop(columns="paper_start")
    return {"reacher": some["cartpole"], "reacher-scale": scale}


def test_the_figure_shows_every_method_in_two_panels():
    import matplotlib.pyplot as plt

    figure = draw(tables())["cartpole"]
    left, right = figure.axes
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == [f"{DISTILLED} (66 %, 95 % shaded)", f"{BO} (66 %, 95 % shaded)", RANDOM]
    assert left.get_title(loc="left").startswith("a  cartpole")
    assert right.get_xlabel() == "trial"
    # two bands for each of the two methods of the paper
    assert len(left.collections) == 4
    [line] = [line for line in left.get_lines() if line.get_label() == RANDOM]
    assert line.get_ydata() == pytest.approx([0.502] * 3)
    plt.close(figure)
