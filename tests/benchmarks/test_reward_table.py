"""The reward table, on a few short episodes, and its text and figure on made-up records."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _models, _reward_models, _rewards, reward_table
from benchmarks.paper._reward_page import MAPPING, PAPER, brief, draw, report, table
from benchmarks.paper._tasks import environment
from benchmarks.paper.reward_table import BENCHMARK, MODELS, settings

FILES = {f"{task}.{kind}" for task in PAPER for kind in ("json", "csv", "md", "png", "svg")}
METHODS = ["GP", "NN", "D, logged actions", "D, predicted actions", "T"]


def few(task, seed):
    env = environment(task)
    return tuple(env.collect(10, 12, random_state=2 * seed + k) for k in (0, 1))


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_rewards, "flown", few)
    monkeypatch.setattr(_reward_models, "QUICK_STEPS", 10)
    monkeypatch.setattr(_models, "QUICK_EPOCHS", {"T": 1, "one-step": 1})
    tiny = dict.fromkeys(_reward_models.MAX_ROWS["quick"], 12)
    monkeypatch.setitem(_reward_models.MAX_ROWS, "quick", tiny)
    monkeypatch.setitem(_reward_models._NN[1], "estimator__max_steps", 20)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_the_whole_table_comes_out_task_by_task(small, tmp_path, monkeypatch, capsys):
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    folder = tmp_path / "reward-table"
    BENCHMARK.main(["--task", "cartpole", *options])
    printed = capsys.readouterr().out
    assert "0.884 ± 1.873" in printed
    assert "quick mode" in printed
    first = contents(folder)
    assert set(first) == {name for name in FILES if name.startswith("cartpole")}
    facts = json.loads(first["cartpole.json"])
    assert (facts["mode"], facts["seeds"], facts["tables"]) == ("quick", [0], ["cartpole"])
    assert facts["settings"]["length"] == 200
    # the other task adds its own files; a few of its models do
    some = {"paper": MODELS["paper"], "tuned": ["GP", "T, features"], "-": ["constant"]}
    monkeypatch.setattr(reward_table, "MODELS", some)
    BENCHMARK.main(["--task", "reacher", *options])
    both = contents(folder)
    assert set(both) == FILES
    assert {name: both[name] for name in first} == first
    for task in PAPER:
        rows = pd.read_csv(folder / f"{task}.csv")
        assert rows[rows["settings"] == "paper"]["row"].tolist() == METHODS
        assert (rows["row"] == "constant").sum() == 1
        # chosen on training folds only: the configuration is listed
        tuned = rows[rows["settings"] == "tuned"]["config"].map(json.loads)
        assert len(tuned)
        assert all("symmetry" in config for config in tuned)
    assert set(pd.read_csv(folder / "cartpole.csv")["row"]) == set(MAPPING)
    assert "0.127 ± 0.192" in (folder / "reacher.md").read_text()
    BENCHMARK.main([*options, "--redraw"])
    assert contents(folder) == both


def test_the_settings_name_what_was_tried():
    for task, facts in settings("full").items():
        assert set(facts["candidates"]) == set(MODELS["tuned"])
        assert {len(tried) for tried in facts["candidates"].values()} == {4}
        assert facts["task"] == task


# -- text and figure ------------------------------------------------------------------------------


def records(own=np.nan):
    """Three seeds of some rows: T worse on each, D lost on two of them."""
    lines = []
    for seed in (0, 1, 2):
        for kind, row, mean, diverged, far in [
            ("-", "constant", 0.4 + 0.1 * seed, 0, np.nan),
            ("paper", "T", 0.01 * (1 + seed**2), 0, 0),
            ("tuned", "T", 0.005, 0, 0),
            ("paper", "GP", 0.03, 0, np.nan),
            ("paper", "D, logged actions", np.inf if seed else 3e5, 7 * seed, 30),
        ]:
            line = {"settings": kind, "row": row, "seed": seed, "n_episodes": 100, "mean": mean}
            line |= {"std": 0.1, "median": mean / 10, "own_goal": own if row != "GP" else np.nan}
            lines.append(line | {"n_diverged": diverged, "n_far": far, "seconds": 1.0})
    return pd.DataFrame(lines)


def test_the_table_is_ordered_and_averages_over_seeds():
    frame = table("cartpole", records())
    assert list(zip(frame["settings"], frame["method"], strict=True)) == [
        ("paper", "GP"),
        ("paper", "D, logged actions"),
        ("paper", "T"),
        ("tuned", "T"),
        ("-", "constant"),
    ]
    line = frame.iloc[2]
    assert line["MSE"] == pytest.approx(0.08 / 3)
    assert line["MSE std over seeds"] == pytest.approx(np.std([0.01, 0.02, 0.05], ddof=1))
    assert line["paper"] == "0.01 ± 0.033"
    assert pd.isna(frame.iloc[3]["paper"])


def test_infinite_is_infinite_and_counted():
    line = table("cartpole", records()).iloc[1]
    assert line["MSE"] == np.inf
    assert np.isnan(line["MSE std over seeds"])
    assert (line["diverged"], line["lost"], line["episodes"]) == (21, 90, 300)
    assert "| D, logged actions | 0.057 | 21 of 300 diverge |" in brief("cartpole", records())


def test_the_short_table_of_cartpole():
    lines = brief("cartpole", records()).splitlines()
    head = "| method | paper prints | its settings, actions aligned | tuned | library defaults |"
    assert lines[0] == head
    assert "| T | 0.01 | 0.027 ± 0.02 | 0.005 ± 0 |  |" in lines
    assert lines[-1] == "| constant |  |  |  | 0.5 ± 0.1 |"
    assert len(lines) == 6


def test_goals_of_their_own_are_compared_with_the_paper():
    lines = brief("reacher", records(own=0.002)).splitlines()
    assert lines[0].startswith("| method | paper prints | its settings, own goals | its settings,")
    assert "| T | 0.005 | 0.002 | 0.027 ± 0.02 | 0.005 ± 0 |  |" in lines
    assert "| GP | 0.127 |  | 0.03 ± 0 |  |  |" in lines
    assert "MSE, own goals" in report({"reacher": records(own=0.002)})
    assert "own goals" not in report({"cartpole": records()})


def test_the_figure_shows_every_row_and_what_is_off_the_axis():
    import matplotlib.pyplot as plt

    figure = draw({"cartpole": records()})["cartpole"]
    (ax,) = figure.axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["GP", "D, logged actions", "T"]
    shown = {(line.get_marker(), *np.round(line.get_xdata(), 6)) for line in ax.get_lines()}
    assert {("s", 0.03), ("s", 0.026667), ("o", 0.005), (">", 10.0)} <= shown
    assert [text.get_text() for text in ax.texts] == ["21 of 300 diverge"]
    assert "paper's settings" in figure.legends[0].get_texts()[0].get_text()
    plt.close(figure)
