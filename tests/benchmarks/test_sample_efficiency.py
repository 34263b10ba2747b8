"""Sample efficiency, on a few short episodes."""

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import sample_efficiency as module
from benchmarks.paper._models import build
from trajlearn import Reacher, horizon_errors
from trajlearn.exceptions import HorizonWarning

SIZES = {"n_steps": 5, "n_test": 3}


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(module, "N_REFERENCE", 3)
    monkeypatch.setattr(module, "TEST_LENGTH", 12)
    for mode in ("full", "quick"):
        monkeypatch.setitem(module.LENGTHS, mode, [5, 8])
        monkeypatch.setitem(module.COUNTS, mode, [1, 3])
        monkeypatch.setitem(module.N_STEPS, mode, SIZES["n_steps"])
        monkeypatch.setitem(module.N_TEST, mode, SIZES["n_test"])


def synthetic(errors):
    """Tables in which every model has the errors of a function of (model, actions, L, N, seed)."""
    lines = []
    keys = [*module.PAPER, *module.OURS, ("D (ours), clipped", "logged")]
    for model, actions in keys:
        for length in (5, 100):
            for n in (1, 20):
                for seed in range(3):
                    value = errors(model, actions, length, n, seed)
                    line = {"seed": seed, "n_episodes": n, "model": model, "actions": actions}
                    parts = dict.fromkeys(["error", "first", "within", "beyond"], value)
                    lines.append(line | {"length": length} | parts)
    still = [
        {"seed": seed, "length": length, "error": 0.5, "first": 0.1, "within": 0.2, "beyond": 0.9}
        for seed in range(3)
        for length in (5, 100)
    ]
    return {
        "errors": pd.DataFrame(lines),
        "no-change": pd.DataFrame(still),
        "data": module.data_sizes([5, 8], [1, 3]),
    }


def test_seeds_of_training_test_and_reference_never_meet(small):
    starts = [
        tuple(episode.states[0])
        for seed in range(3)
        for ds in module.episodes(seed, n_test=3)
        for episode in ds
    ]
    reference = Reacher().collect(3, 1, random_state=module.REFERENCE_SEED)
    starts += [tuple(episode.states[0]) for episode in reference]
    assert len(starts) == len(set(starts)) == 3 * (3 + 3) + 3


def test_less_data_are_the_beginning_of_more_data(small):
    train, _ = module.episodes(0, n_test=1)
    few = train[:1].truncate(5)
    np.testing.assert_array_equal(few[0].states, train[0].states[:6])
    np.testing.assert_array_equal(few[0].params, train[0].params)


def test_errors_are_those_of_the_library_in_the_unit_of_the_reference(small):
    train, test = module.episodes(0, n_test=3)
    width = module.reference_width()
    model = build("T", "default", policy=None, mode="quick", seed=0)
    model.set_params(estimator__max_steps=5).fit(train)
    with pytest.warns(HorizonWarning):
        predicted = model.predict(test)
    mean = np.asarray(predicted)
    predicted.state_range = np.stack([np.zeros_like(width), width])
    expected = horizon_errors(predicted, test).to_numpy()
    np.testing.assert_allclose(module.episode_errors(mean, test, width), expected)


def test_a_summary_is_the_median_over_episodes_of_means_over_horizons():
    errors = np.array([[1.0, 3.0, 5.0], [2.0, 4.0, np.inf], [0.0, 0.0, 0.0]])
    assert module.summary(errors, 2) == {
        "error": 3.0,
        "first": 1.0,
        "within": 2.0,
        "beyond": 5.0,
        "n_diverged": 1,
    }
    assert np.isnan(module.summary(errors, 3)["beyond"])


def test_no_change_keeps_the_first_state(small):
    table = module.no_change(0, lengths=[5, 12], n_test=3)
    _, test = module.episodes(0, n_test=3)
    width = module.reference_width()
    moved = [
        (((episode.states[1:] - episode.states[0]) / width) ** 2).mean(axis=1) for episode in test
    ]
    assert table["error"].tolist() == pytest.approx([np.median(np.mean(moved, axis=1))] * 2)
    within = np.median([np.mean(errors[:5]) for errors in moved])
    assert table["within"][0] == pytest.approx(within)
    assert table["beyond"].isna().tolist() == [False, True]


def test_pairs_grow_with_the_square_of_the_length():
    data = module.data_sizes([5, 10], [1, 3])
    length, n = data["length"], data["n_episodes"]
    assert (data["transitions"] == n * length).all()
    assert (data["pairs"] == n * length * (length + 1) // 2).all()
    # 25 passes over less than a batch, 8 over one batch
    assert data.loc[0, ["epochs_D", "epochs_T"]].tolist() == [25, 8]


@pytest.mark.parametrize(
    ("model", "settings", "shown"),
    [
        ("D", "paper", {("D", "logged"), ("D", "policy")}),
        ("PE", "paper", {("PE", "logged"), ("PE", "policy")}),
        ("T", "paper", {("T", "none")}),
        (
            "D",
            "default",
            {
                (f"D (ours){clip}", how)
                for clip in ("", ", clipped")
                for how in ("logged", "policy")
            },
        ),
        ("T", "default", {("T (ours)", "none"), ("T (ours), clipped", "none")}),
    ],
    ids=["D-paper", "PE-paper", "T-paper", "D-default", "T-default"],
)
def test_the_least_data_are_enough_for_every_model(small, recwarn, model, settings, shown):
    """One episode of five steps: constant parameters, three states a dimension."""
    lines = module.cell(model, settings, 1, [5], seed=0, **SIZES)
    assert {(line["model"], line["actions"]) for line in lines} == shown
    assert len(lines) == len(shown)
    for line in lines:
        assert line["length"] == 5
        assert line["error"] > 0  # and no NaN
        assert line["beyond"] >= line["within"]
    assert not [warning for warning in recwarn if "horizon" in str(warning.message)]


def test_more_steps_and_more_data_change_a_cell(small):
    def error(n=1, n_steps=5, seed=0):
        return module.cell("D", "paper", n, [8], n_steps, 3, seed)[0]["error"]

    values = [error(), error(n=3), error(n_steps=50), error(seed=1)]
    assert len(set(values)) == 4
    assert error() == values[0]


def test_clipped_states_stay_near_the_training_states(small):
    train, test = module.episodes(0, n_test=3)
    few = train[:1].truncate(5)
    low, high = few.states.min(axis=0), few.states.max(axis=0)
    beyond = 0.5 * (module.CLIP - 1) * (high - low) + 1e-12
    for model, actions in (("D", "policy"), ("T", "none")):
        estimator = build(model, "default", policy=Reacher().policy, mode="quick", seed=0)
        estimator.set_params(estimator__max_steps=100).fit(few)
        free = module.forecast(estimator, test, actions, clip=None)
        held = module.forecast(estimator, test, actions, clip=module.CLIP)
        assert ((held >= low - beyond) & (held <= high + beyond)).all()
        assert not ((free >= low - beyond) & (free <= high + beyond)).all()
        # within a roll-out the step after a held state is another one
        afterwards = np.clip(free, held.min(axis=(0, 1)), held.max(axis=(0, 1)))
        assert np.allclose(afterwards, held) == (model == "T")
        again = module.forecast(estimator, test, actions, clip=None)
        np.testing.assert_array_equal(free, again)


def test_the_report_counts_cells_and_names_the_best():
    def errors(model, actions, length, n, seed):
        if model == "T":
            return 0.2
        if length == 100 and (model, actions) == ("D", "policy"):
            return 0.1 if n == 20 else 0.4
        if model == "T (ours)":
            return 0.6 if n == 1 else 0.3
        # a single seed in which D wins does not make a cell
        return 0.1 if (model, seed) == ("D", 0) else np.inf

    tables = synthetic(errors)
    report = module.report(tables)
    lines = {tuple(cells[:2]): cells[2:] for cells in _rows(report) if cells[0] == "T"}
    assert lines["T", "D, logged actions"] == ["4 of 4", "0", "inf", "2 of 2", "inf"]
    assert lines["T", "D, recomputed actions"] == ["3 of 4", "1", "inf", "1 of 2", "1.2"]
    grid = report.split("Best model in each cell, the paper's settings")[1]
    assert "| 5 | T | T |\n| 100 | T | D r |" in grid
    # of ours, 0.6 is no better than the 0.5 of no change
    assert "| 5 | (T) | T |" in grid
    assert "| D, recomputed actions | 0.1 (0.1 to 0.1) | 20 |" in report


def _rows(report):
    lines = [line for line in report.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_figures_show_diverged_models():
    import matplotlib.pyplot as plt

    def errors(model, actions, length, n, seed):
        return np.inf if length == 5 and model != "T" else 0.03 / n + 0.001 * seed

    figures = module.draw(synthetic(errors))
    assert set(figures) == {"sample-efficiency", "sample-efficiency-slices"}
    maps = figures["sample-efficiency"].axes[:10]
    texts = [[text.get_text() for text in ax.texts] for ax in maps]
    # (L, N) row by row; T, the last on the left, is the only one that is finite at L = 5
    assert texts[0] == ["∞", "∞", ".031", ".0025"]
    assert texts[8] == [".031", ".0025", ".031", ".0025"]
    assert len({tuple(ax.images[0].get_clim()) for ax in maps}) == 1
    [legend] = figures["sample-efficiency-slices"].legends
    names = [text.get_text() for text in legend.get_texts()]
    assert len(names) == len(set(names)) == 8
    for figure in figures.values():
        plt.close(figure)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0036, ".0036"), (0.5, ".5"), (7.25, "7.2"), (22.4, "22"), (535, "5e2"), (3e10, "3e10")],
)
def test_numbers_are_short(value, text):
    assert module._number(value) == text


def test_the_command_writes_tables_and_text(small, tmp_path, capsys):
    # figures take longer than all the rest
    benchmark = dataclasses.replace(module.BENCHMARK, draw=lambda tables: {})
    arguments = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    benchmark.main(arguments)
    printed = capsys.readouterr().out
    assert "quick mode" in printed
    folder = tmp_path / "sample-efficiency"
    errors = pd.read_csv(folder / "errors.csv")
    # five models, some of them with several lines, two lengths and two numbers of episodes
    assert len(errors) == (2 + 2 + 1 + 4 + 2) * 4
    assert not errors["error"].isna().any()
    assert (folder / "sample-efficiency.md").read_text() in printed
    facts = json.loads((folder / "sample-efficiency.json").read_text())
    assert facts["settings"]["lengths"] == [5, 8]
    assert facts["tables"] == ["errors", "no-change", "data"]
