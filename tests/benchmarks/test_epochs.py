"""Error against epochs, on a few short episodes."""

import sys

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _tasks, epochs


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_tasks, "N_EPISODES", 4)
    for task in _tasks.TASKS:
        monkeypatch.setitem(_tasks.TASKS, task, _tasks.Task(50, 50))
    monkeypatch.setattr(epochs, "N_TEST", {"quick": 5})
    few = {"paper": (1, 3), "one-cycle": (1,), "default": (1,)}
    monkeypatch.setattr(epochs, "EPOCHS", {"quick": few})


@pytest.fixture
def tables():
    """A model that improves up to 8 epochs on seed 0, up to 16 on seed 1; ours is twice as good."""
    lines = []
    for seed, values in enumerate([(0.04, 0.01, 0.02), (0.04, 0.02, 0.01)]):
        for n, error in zip((1, 8, 16), values):
            common = {"task": "reacher", "epochs": n, "seed": seed, "steps": 10 * n, "rows": n}
            for model, factor in zip(epochs.MODELS.values(), (1, 1, 0.5)):
                value = {"mean": factor * error, "median": factor * error / 10, "train": 0.001}
                lines.append(common | {"model": model} | value)
    return {"errors": pd.DataFrame(lines)}


def test_all_models_get_the_same_steps(small):
    train, _ = _tasks.episodes("cartpole", 0)
    fitted = [epochs.build(s, 1, train, 0).fit(train).estimator_ for s in epochs.MODELS]
    assert len({learner.n_steps_ for learner in fitted}) == 1
    n_rows = 4 * 50 * 51 // 2
    assert fitted[0].n_steps_ == -(-n_rows // 64)


def test_a_shorter_run_is_the_beginning_of_a_longer_one(small):
    train, _ = _tasks.episodes("cartpole", 0)
    short, long = (epochs.build("paper", n, train, 0).fit(train).estimator_ for n in (1, 2))
    n_steps = len(short.loss_curve_)
    assert n_steps == short.n_steps_  # so few that every loss is noted
    np.testing.assert_array_equal(short.loss_curve_, long.loss_curve_[:n_steps])


def test_one_cycle_differs_in_the_schedule_alone(small):
    train, _ = _tasks.episodes("cartpole", 0)
    one, other = (epochs.build(s, 3, train, 0).get_params() for s in ("paper", "one-cycle"))
    plain = (int, float, str)
    differ = {key for key in one if isinstance(one[key], plain) and one[key] != other[key]}
    assert differ == {"estimator__schedule", "estimator__learning_rate"}


def test_report_finds_the_best_epochs_of_each_seed(tables):
    text = epochs.report(tables)
    assert "by the mean: 8 (seed 0), 16 (seed 1)" in text
    assert "8 epochs are best on 1 of 2 seeds; their error is +50% (+0% to +100%)" in text
    assert "From 8 to 16 epochs it changes by +25% (-50% to +100%); in the paper by +7%" in text
    assert "Error of T, epochs 16: 1 (1 to 1) times that with a one-cycle schedule" in text
    assert "2 (2 to 2) times that of ours" in text
    tables["errors"] = tables["errors"].query("model != 'T, one-cycle' or epochs < 16")
    assert "Error of T, epochs 16: 2 (2 to 2) times that of ours" in epochs.report(tables)


def test_the_paper_prints_for_the_reacher_alone(tables):
    assert "paper prints" in epochs.report(tables)
    tables["errors"]["task"] = "cartpole"
    assert "paper prints" not in epochs.report(tables)


def test_the_whole_command(small, tmp_path, monkeypatch, capsys):
    arguments = ["epochs", "--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    epochs.BENCHMARK.main()
    printed = capsys.readouterr().out
    assert "### reacher" in printed
    assert "Best epochs of the paper's T" in printed
    errors = pd.read_csv(tmp_path / "epochs" / "errors.csv")
    curves = pd.read_csv(tmp_path / "epochs" / "curves.csv")
    assert errors.groupby(["task", "model"]).size().to_dict() == {
        (task, model): 2 if model == "T" else 1
        for task in ("cartpole", "reacher")
        for model in epochs.MODELS.values()
    }
    assert (errors[errors["model"] == "T (ours)"]["rows"] == 4 * errors["rows"].min()).all()
    # the training length and no further
    assert curves["horizon"].max() == 50
    assert np.isfinite(errors["mean"]).all()
    assert (tmp_path / "epochs" / "epochs.png").stat().st_size > 4_000
