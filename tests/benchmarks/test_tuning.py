"""The paper's sweeps of hyper-parameters, on a few short episodes."""

import sys

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _grids, _tasks, _tuning_report, tuning
from trajlearn import paper

FOLDS = [(seed, fold) for seed in range(2) for fold in range(3)]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_tasks, "N_EPISODES", 6)
    monkeypatch.setitem(_tasks.TASKS, "cartpole", _tasks.Task(12, 12))
    plans = [
        tuning.Plan("cartpole", "D", 1, ("depth", "learning rate")),
        tuning.Plan("cartpole", "T", 1, ("rows",)),
    ]
    monkeypatch.setattr(tuning, "PLANS", {"quick": plans})


def sweep(errors, parameter="learning rate", actions="none", final=2e-3):
    """Scores of values, each with an error a seed and fold; the greatest value is beyond."""
    lines = []
    for value, by_fold in errors.items():
        origin = "final" if value == final else "beyond" if value == max(errors) else "swept"
        for (seed, fold), error in zip(FOLDS, by_fold):
            lines.append(
                {
                    "task": "cartpole",
                    "model": "T",
                    "parameter": parameter,
                    "value": value,
                    "origin": origin,
                    "seed": seed,
                    "fold": fold,
                    "actions": actions,
                    "steps": 10.0,
                    "mean": error,
                    "median": error / 2,
                    "fit_seconds": 1.0,
                }
            )
    return pd.DataFrame(lines)


@pytest.mark.parametrize(
    ("model", "parameter"), [(m, p) for m, swept in _grids.SWEPT.items() for p in swept]
)
def test_final_values_are_those_of_the_paper_models(model, parameter):
    final = _grids.FINAL[model][parameter]
    assert final in _grids.SWEPT[model][parameter]
    epochs = 3
    asked = _grids.setting(model, parameter, final, epochs)
    have = paper.model(model).get_params()
    if parameter == "training length":
        assert asked == {"window": _tasks.TASKS["cartpole"].length}
        assert have["window"] is None  # the whole episode
        return
    if parameter == "rows, same steps":
        n_rows, batch = have["relabeler__max_rows"], have["estimator__batch_size"]
        assert asked.pop("estimator__max_steps") == epochs * n_rows // batch
        assert asked.pop("estimator__max_epochs") is None
    assert {name: np.array(have[name]).tolist() for name in asked} == asked


def test_each_value_is_another_setting():
    for model, swept in _grids.SWEPT.items():
        for parameter in swept:
            values = _grids.values(model, parameter)
            settings = [_grids.setting(model, parameter, value, 2) for value in values]
            assert all(settings.count(one) == 1 for one in settings)
            # a valid setting of that model, under the same names
            assert all(set(one) <= set(paper.model(model).get_params()) for one in settings)
            extra = [v for v in values if _grids.origin(model, parameter, v) == "beyond"]
            assert len(extra) == (parameter == "learning rate")
            assert all(value > max(_grids.SWEPT[model][parameter]) for value in extra)


@pytest.mark.parametrize(
    ("value", "text"),
    [(250, "250"), (5e-5, "5e-5"), (1e-3, "1e-3"), (5e4, "5e4"), (2.5e6, "2.5e6")],
)
def test_values_are_written_shortly(value, text):
    assert _grids.shown(value) == text


def test_the_scorer_is_the_estimators_own_score(small):
    ds = _tasks.environment("cartpole").collect(6, 12, random_state=0)
    env = _tasks.environment("cartpole")
    model = paper.model("D", policy=env.policy, random_state=0, estimator__max_epochs=1).fit(ds[:4])
    scores = tuning.Errors(["logged", "policy"])(model, ds[4:])
    for source in ("logged", "policy"):
        own = model.set_params(rollout_actions=source).score(ds[4:])
        assert scores[f"{source}_mean"] == pytest.approx(own, rel=1e-12)
        # of two episodes the median is the mean
        assert scores[f"{source}_median"] == pytest.approx(own, rel=1e-12)
    assert scores["logged_mean"] != scores["policy_mean"]


def test_the_final_value_need_not_be_fitted_again_for_each_sweep(small):
    common = {"task": "cartpole", "model": "T", "epochs": 1, "n_episodes": 6, "seed": 1}
    grid = [{}] + [_grids.setting("T", p, v, 1) for p, v in _grids.FINAL["T"].items()]
    scores = [result["none_mean"] for result in tuning.cell(grid=grid[:4], **common)]
    assert scores[1:] == scores[:1] * 3
    assert len(set(scores[0])) == 3  # folds differ


def test_a_fit_that_fails_is_infinite(small):
    grid = [{}, {"estimator__learning_rate": 1e9}]
    fine, failed = tuning.cell("cartpole", "T", 1, grid, 6, 0)
    assert np.isfinite(fine["none_mean"]).all()
    lines = tuning._by_fold({"value": 1e9}, "none", failed)
    assert (lines["mean"] == np.inf).all()
    assert (lines["median"] == np.inf).all()
    assert lines["steps"].isna().all()


@pytest.mark.parametrize(
    ("other", "holds", "better"),
    [
        ([3.0] * 6, "yes", ""),
        ([1.0] * 5 + [2.1], "within the spread", "5 of 6"),
        ([1.0] * 6, "no", "6 of 6"),
        ([np.inf] + [1.0] * 5, "yes", ""),
    ],
)
def test_verdict_of_a_sweep(other, holds, better):
    # the best of all is beyond the sweep, and does not count
    scores = sweep({1e-3: other, 2e-3: [2.0] * 6, 3e-3: [0.5] * 6})
    [verdict] = _tuning_report._verdicts(scores).to_dict("records")
    assert (verdict["holds"], verdict["folds where better"]) == (holds, better)
    assert verdict["best swept"] == ("2e-3" if holds == "yes" else "1e-3")
    [higher] = _tuning_report._higher_rates(scores).to_dict("records")
    assert higher["rate"] == "3e-3"
    assert higher["error / that of the final rate"] == "0.25 (0.25 to 0.25)"
    assert higher["folds where better"] == "6 of 6"


def test_what_a_choice_by_logged_actions_costs():
    recomputed = sweep({1e-3: [4.0] * 6, 2e-3: [2.0] * 6, 3e-3: [3.0] * 6}, actions="policy")
    logged = sweep({1e-3: [1.0] * 6, 2e-3: [2.0] * 6, 3e-3: [9.0] * 6}, actions="logged")
    scores = pd.concat([recomputed, logged])
    [line] = _tuning_report._chosen_by_logged(scores).to_dict("records")
    assert (line["best, logged"], line["best, recomputed"]) == ("1e-3", "2e-3")
    assert line["recomputed error of the first / second"] == "2 (2 to 2)"


def test_the_whole_command(small, tmp_path, monkeypatch, capsys):
    arguments = ["tuning", "--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    tuning.BENCHMARK.main()
    printed = capsys.readouterr().out
    assert "The paper's final value is the best of its own sweep in" in printed
    assert "5e-5 (paper)" in printed
    assert "1e-3 (beyond)" in printed
    scores = pd.read_csv(tmp_path / "tuning" / "scores.csv")
    sizes = scores.groupby(["model", "parameter", "actions"]).size().to_dict()
    assert sizes == {
        ("D", "depth", "logged"): 6,
        ("D", "depth", "policy"): 6,
        ("D", "learning rate", "logged"): 12,
        ("D", "learning rate", "policy"): 12,
        ("T", "rows", "none"): 15,
    }
    finals = scores[(scores["origin"] == "final") & (scores["actions"] == "policy")]
    by_parameter = [some["mean"].tolist() for _, some in finals.groupby("parameter")]
    assert by_parameter[0] == by_parameter[1]
    for name in ("D", "T"):
        assert (tmp_path / "tuning" / f"tuning-{name}.png").stat().st_size > 4_000


@pytest.mark.parametrize(
    ("sizes", "rows"), [([4, 4, 1, 1], [4, 4, 2]), ([6, 4], [4, 2, 4]), ([1], [1]), ([5], [4, 1])]
)
def test_small_groups_of_panels_share_a_row(sizes, rows):
    groups = [pd.DataFrame({"parameter": [f"p{i}" for i in range(n)]}) for n in sizes]
    assert [len(row) for row in _tuning_report._rows(groups)] == rows
