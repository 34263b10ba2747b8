"""Planning, on a few short trials; its text and figures on made-up trials."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _models, _planning_refit, _planning_trials, planning
from benchmarks.paper._command import read_tables
from benchmarks.paper._planning_figures import draw
from benchmarks.paper._planning_page import report
from benchmarks.paper._planning_refit import COUNTED, usable
from benchmarks.paper._planning_trials import (
    LENGTH,
    PLANNERS,
    TASK,
    bounds,
    cell,
    fitted,
    references,
    starts,
    true_returns,
)
from trajlearn import Cartpole, TrajectoryDataset

SOME = ["T, hold all", "T, hold 25", "D over actions, hold all", "LQR", "random policy"]


@pytest.fixture
def small(monkeypatch):
    fitted.cache_clear()
    monkeypatch.setattr(_models, "QUICK_STEPS", 15)
    for table, value in [
        ("N_TRIALS", 2),
        ("N_COSTLY", 1),
        ("N_CANDIDATES", 8),
    ]:
        monkeypatch.setitem(getattr(_planning_trials, table), "quick", value)
    monkeypatch.setattr(_planning_trials, "N_TRAIN", 6)
    monkeypatch.setattr(_planning_trials, "N_CHOICES", 6)
    for table, value in [("N_MORE", 2), ("N_TEST", 4), ("N_CANDIDATES", 8)]:
        monkeypatch.setitem(getattr(_planning_refit, table), "quick", value)
    monkeypatch.setattr(_planning_refit, "N_FIRST", 5)
    yield
    fitted.cache_clear()


def test_everything_comes_out(small, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_planning_trials, "PLANNERS", {name: PLANNERS[name] for name in SOME})
    monkeypatch.setattr(_planning_refit, "HOLDS", [None, 25, "random"])
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    planning.BENCHMARK.main(options)
    assert "quick mode" in capsys.readouterr().out
    folder = tmp_path / "planning"
    facts = json.loads((folder / "planning.json").read_text())
    assert facts["settings"]["n_trials"] == 2
    tables = read_tables(folder, "planning")
    trials = tables["trials"]
    assert trials.groupby("planner").size().to_dict() == dict.fromkeys(SOME, 2)
    assert trials["return"].between(0, 1).all()
    decided = trials[trials["n_decisions"].notna()]
    assert (decided["trial_s"] >= decided["decision_s"]).all()
    # whoever holds all decides once, and a reference never
    assert (decided[decided["planner"].str.endswith("all")]["n_decisions"] == 1).all()
    assert set(trials["planner"]) - set(decided["planner"]) == {"LQR", "random policy"}
    rows = tables["rows"].pivot(index="hold", columns="horizon", values="rows")
    assert (rows.loc["nothing"] == 0).all()
    assert rows.loc["planned, hold 25", 200] == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    planning.BENCHMARK.main([*options, "--redraw"])
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


# -- trials -------------------------------------------------------------------------------------


def test_starts_are_common_and_near_upright():
    np.testing.assert_array_equal(starts(3), starts(25)[:3])
    assert np.abs(starts(25)[:, [0, 2]]).max() <= 0.25


def test_a_reference_flies_what_it_says():
    at = starts(3)
    gains = references("LQR", at, 10, 0)
    expected = TASK.returns(TASK.env.rollout(at, gains, LENGTH))
    records = cell("LQR", [0, 1, 2], "full", 0)
    np.testing.assert_allclose([record["return"] for record in records], expected)
    assert [record["changes"] for record in records] == [0, 0, 0]


def test_the_simulator_picks_the_best_candidate():
    at = starts(2)
    best = references("simulator, hold all", at, 20, 0)
    for start, gains in zip(at, best, strict=True):
        low, high = bounds().T
        others = np.random.default_rng(5).uniform(low, high, size=(5, 4))
        assert true_returns(start, gains[None])[0] >= np.median(true_returns(start, others))
    assert not np.allclose(references("simulator, hold all", at, 20, 1), best)


def test_a_fall_earns_nothing_after_it():
    away = np.zeros((1, 4))
    (some,) = true_returns(np.array([0.0, 0.0, 0.2, 0.0]), away)
    fallen = TASK.env.rollout([[0.0, 0.0, 0.2, 0.0]], away[0], LENGTH)
    assert fallen.terminated[0]
    assert some == pytest.approx(TASK.returns(fallen)[0])
    assert some < fallen.lengths[0] / LENGTH


def test_logs_differ_in_starts_and_falls(monkeypatch):
    monkeypatch.setattr(_planning_trials, "N_TRAIN", 30)
    paper, own = (_planning_trials.log(name, 0) for name in ("T", "T, own starts"))
    assert not paper.terminated.any()
    first = np.abs(own.states[own.offsets[:-1]])
    assert first[:, [0, 2]].max() <= 0.25
    assert np.abs(paper.states[paper.offsets[:-1]])[:, 0].max() > 0.5


def test_costly_trials_are_shared_out_among_the_seeds():
    class Run:
        mode, seeds = "full", [0, 1, 2]

    shares = [planning._shares(True, Run, seed) for seed in Run.seeds]
    together = sorted(trial for share in shares for part in share for trial in part)
    assert together == list(range(_planning_trials.N_COSTLY["full"]))
    assert max(len(part) for share in shares for part in share) <= _planning_trials.CHUNK
    assert planning._shares(False, Run, 1) == [list(range(_planning_trials.N_TRIALS["full"]))]


# -- data in which theta changes ------------------------------------------------------------------


def episodes(*thetas):
    """Episodes with theta given at every step."""
    params = [np.array(theta, dtype=float)[:, None] for theta in thetas]
    states = [np.zeros((len(theta) + 1, 1)) for theta in thetas]
    return TrajectoryDataset.from_arrays(states, params=params)


def test_rows_are_counted_in_stretches():
    counts = usable(episodes([1, 1, 1, 2, 2, 3], [4, 4, 4, 4, 4, 4, 5]))
    assert dict(zip(COUNTED, counts, strict=True))[1] == 13
    # only the six steps under 4 hold five in a row
    assert dict(zip(COUNTED, counts, strict=True))[5] == 2
    assert usable(None) == [0] * len(COUNTED)


def test_rows_agree_with_the_relabeler():
    from trajlearn import SubtrajectoryRelabeler

    ds = episodes([1, 1, 1, 2, 2, 3], [4, 4, 4, 4, 4, 4, 5])
    rows, _ = SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    counts = dict(zip(COUNTED, usable(ds), strict=True))
    for horizon in (1, 5):
        assert np.isclose(rows[:, 1], horizon).sum() == counts[horizon]


def test_joined_logs_keep_their_thetas():
    first = Cartpole(redraw_terminated=True).collect(2, 30, random_state=0)
    added = first[:1].assign(params=[np.repeat([[1.0] * 4, [2.0] * 4], 15, axis=0)])
    both = _planning_refit._joined(first, added)
    assert len(both) == 3
    np.testing.assert_array_equal(both[0].params, first.params[0])
    assert np.unique(both[2].params, axis=0).tolist() == [[1.0] * 4, [2.0] * 4]


# -- text and figures -----------------------------------------------------------------------------


def made_up():
    trials, choices, rows, errors, refits = [], [], [], [], []
    for seed in (0, 1, 2):
        for trial in (0, 1):
            for name, value in [("T, hold all", 0.3), ("T, hold 1", 0.9), ("LQR", 0.8)]:
                plans = {"n_decisions": 200, "decision_s": 0.04, "trial_s": 8.0, "predicted": 0.99}
                trials.append(
                    {"planner": name, "seed": seed, "trial": trial, "return": value + 0.01 * trial}
                    | {"steps": 40, "fell": value < 0.5, "changes": 0.0}
                    | (plans if name != "LQR" else dict.fromkeys(plans, np.nan))
                )
        for model, true in (("T", 0.2), ("D", 0.95)):
            for step in (0, 25):
                choices.append(
                    {"planner": "T, hold all", "model": model, "seed": seed, "trial": 0}
                    | {"step": step, "rank": 0.5, "predicted": 0.97, "true": true, "best": 0.98}
                    | {"mean": 0.9, "low": 0.03, "pick_low": true < 0.5}
                    | {"speed_factor": 1.4, "rate_factor": 0.5}
                )
        for hold in ("nothing", "planned, hold 25"):
            key = {"hold": hold, "seed": seed}
            rows += [key | {"horizon": h, "rows": 7 if hold != "nothing" else 0} for h in COUNTED]
            errors += [key | {"horizon": h, "median": 0.01, "mean": 0.1} for h in (1, 25, 50, 200)]
            refits += [
                key | {"trial": 0, "return": 0.5, "steps": 90, "fell": True, "when": when}
                for when in (["next"] if hold == "nothing" else ["added", "next"])
            ]
    frames = {"trials": trials, "choices": choices, "rows": rows, "errors": errors}
    return {name: pd.DataFrame(lines) for name, lines in (frames | {"refits": refits}).items()}


def test_the_text_holds_what_the_tables_say():
    text = report(made_up())
    assert "| T, hold all | 6 | 0.305 ± 0.005 |" in text
    assert "6 (step 40)" in text
    assert (
        "T, hold 1 against T, hold all: 0.905 and 0.305 on the same 6 trials, better in 6." in text
    )
    assert "T, hold 1 and D over policies, hold all were not both run." in text
    assert "0.970 predicted, 0.200 true, with 1.40 and 0.50 times" in text
    assert (
        "Bad there: 3.0 % of the gains, 100 % of the favourites of T, 0 % of the favourites of D."
        in text
    )
    assert "0.500, 3 of 3 fell" in text
    assert "nan" not in text


def test_the_figures_show_every_planner_and_every_log():
    import matplotlib.pyplot as plt

    figures = draw(made_up())
    assert set(figures) == {"planning", "planning-choices", "planning-refit"}
    names = [label.get_text() for label in figures["planning"].axes[0].get_yticklabels()]
    assert names == ["T, hold all", "T, hold 1", "LQR"]
    legend = figures["planning-refit"].legends[0].get_texts()
    assert [text.get_text() for text in legend] == ["nothing", "planned, hold 25"]
    for figure in figures.values():
        plt.close(figure)
