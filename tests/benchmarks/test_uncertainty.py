"""The study of uncertainty: its cells on a few short episodes, its text on made-up tables."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import (
    _models,
    _tasks,
    _uncertainty_flights,
    _uncertainty_models,
    _uncertainty_page,
    _uncertainty_scores,
    _uncertainty_simulated,
    uncertainty,
)
from benchmarks.paper._command import Run, read_tables
from benchmarks.paper._flights_data import FOLDER
from trajlearn import Forecast, TrajectoryDataset

INF = np.inf
LENGTH, N_CALIBRATION, N_TEST = 30, 30, 12


@pytest.fixture(autouse=True)
def no_figure_left():
    yield
    plt.close("all")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_uncertainty_simulated, "N_EPISODES", 8)
    monkeypatch.setitem(_uncertainty_simulated.LENGTH, "quick", LENGTH)
    monkeypatch.setitem(_uncertainty_models.CALIBRATION, "quick", N_CALIBRATION)
    monkeypatch.setitem(_uncertainty_models.TEST, "quick", N_TEST)
    monkeypatch.setitem(_uncertainty_models._PARTICLES, "quick", 3)
    monkeypatch.setattr(_uncertainty_models, "QUICK_STEPS", 5)
    monkeypatch.setattr(_models, "QUICK_STEPS", 10)
    monkeypatch.setattr(_uncertainty_simulated, "N_SAMPLED", 4)
    monkeypatch.setattr(_uncertainty_simulated, "_EXAMPLES", 3)
    monkeypatch.setattr(_uncertainty_scores, "_N_RESAMPLES", 20)


# -- episodes -------------------------------------------------------------------------------------


def test_episodes_for_training_calibration_and_test_never_meet(small):
    every = [_uncertainty_simulated.data("cartpole", 0.0, None, "quick", seed) for seed in (0, 1)]
    starts = np.concatenate(
        [ds.states[ds.offsets[:-1]] for parts in every for ds in parts[:3]]
    ).round(12)
    assert len(starts) == 2 * (8 + N_CALIBRATION + N_TEST)
    assert len(np.unique(starts, axis=0)) == len(starts)
    ids = _uncertainty_scores.forecasts_ids(*every[0][:3])
    assert len(ids) == 8 + N_CALIBRATION + N_TEST
    with pytest.raises(ValueError, match="calibration and for test"):
        _uncertainty_scores.forecasts_ids(every[0].calibration, every[0].calibration)


def test_training_episodes_are_those_of_the_other_benchmarks(small, monkeypatch):
    # how far an episode has to last decides which are drawn again
    monkeypatch.setitem(_tasks.TASKS, "cartpole", _tasks.Task(LENGTH, 2 * LENGTH))
    monkeypatch.setattr(_tasks, "N_EPISODES", 8)
    train, _ = _tasks.episodes("cartpole", 3, n_test=1, test_length=1)
    own = _uncertainty_simulated.data("cartpole", 0.0, None, "quick", 3).train
    first = [ds.states[ds.offsets[:-1]] for ds in (train, own)]
    np.testing.assert_array_equal(*first)


def test_noise_has_one_size_in_all_parts_and_spares_the_truth(small):
    clean = _uncertainty_simulated.data("cartpole", 0.0, None, "quick", 0)
    noisy = _uncertainty_simulated.data("cartpole", 0.2, None, "quick", 0)
    np.testing.assert_array_equal(noisy.true.states, clean.test.states)
    sizes = [
        (some.states - before.states).std(axis=0)
        for some, before in zip(noisy[:3], clean[:3], strict=True)
    ]
    joint = np.concatenate([some.states for some in clean[:3]]).std(axis=0)
    for size in sizes:
        np.testing.assert_allclose(size / joint, 0.2, rtol=0.2)


def test_process_noise_changes_the_quadrotor_alone_where_it_is_asked_for():
    own, other = (_uncertainty_simulated.simulator("quadrotor-sim", p) for p in (None, 0.03))
    assert (own.noise, other.noise) == (0.01, 0.03)
    assert _uncertainty_simulated.simulator("cartpole", None).collect(1, 2, random_state=0)


# -- scores ---------------------------------------------------------------------------------------


def forecasts(std, n=40, n_steps=10, *, seed=0):
    """Forecasts of zero with a std, of unit Gaussian noise; and the episodes."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, n_steps + 1, 2))
    ds = TrajectoryDataset.from_arrays(states)
    shape = (n, n_steps, 2)
    return ds, Forecast(
        np.zeros(shape),
        times=np.tile(np.arange(1.0, n_steps + 1), (n, 1)),
        horizons=np.arange(1, n_steps + 1),
        lengths=np.full(n, n_steps),
        initial_states=states[:, 0],
        initial_times=np.zeros(n),
        start=np.zeros(n, dtype=int),
        diverged_at=np.zeros(n, dtype=int),
        state_range=np.array([[-1.0, -1.0], [1.0, 1.0]]),
        state_names=ds.state_names,
        std=np.full(shape, std),
    )


def test_calibration_mends_a_std_and_reads_no_test_episode():
    both, forecast = forecasts(0.2, n=400)
    calibration, test = both[:300], both[300:]
    raw = {"calibration": forecast[:300], "test": forecast[300:]}
    found = _uncertainty_scores.calibrated(raw, calibration, test)
    assert found.std == pytest.approx(1.0, abs=0.2)
    assert np.mean(
        _uncertainty_scores.by_episode(
            (np.abs(test.states.reshape(100, 11, 2)[:, 1:]) < found.interval(0.9)[1]) * 1.0
        )
    ) == pytest.approx(0.9, abs=0.03)
    # other test states, the same calibration
    moved = TrajectoryDataset.from_arrays(100 * test.states.reshape(100, 11, 2), ids=test.ids)
    again = _uncertainty_scores.calibrated(raw, calibration, moved)
    np.testing.assert_array_equal(again.std, found.std)
    np.testing.assert_array_equal(again.interval(0.9), found.interval(0.9))


def test_short_scores_are_those_of_the_report():
    ds, forecast = forecasts(0.7)
    long, short = _uncertainty_scores.scores(forecast, ds), _uncertainty_scores.brief(forecast, ds)
    assert [(line["first"], line["last"]) for line in long] == [(1, 5), (6, 10)]
    for one, other in zip(long, short, strict=True):
        for name in ("first", "last", "n_episodes", "n_diverged"):
            assert one[name] == other[name]
        for name in ("coverage50", "coverage90", "coverage95", "crps"):
            assert one[name] == pytest.approx(other[name])
        assert other["low"] < other["coverage90"] < other["high"]


def test_bins_end_with_the_forecast():
    assert _uncertainty_scores.bins_of(200)[-2:] == [(76, 150), (151, 200)]
    assert _uncertainty_scores.bins_of(75) == [(1, 5), (6, 25), (26, 75)]


def test_growth_is_in_training_ranges():
    ds, forecast = forecasts(0.5)
    (one, *_, last) = _uncertainty_scores.growth(forecast, ds)
    assert (one["horizon"], last["horizon"]) == (1, 10)
    assert last["std"] == pytest.approx(0.25)
    errors = np.sqrt((ds.states.reshape(40, 11, 2)[:, 10] ** 2).mean(axis=1)) / 2
    assert last["error"] == pytest.approx(np.median(errors))


def test_whole_trajectories_are_inside_at_every_step():
    ds, forecast = forecasts(1.0, n=3, n_steps=4)
    inside = ds.states.reshape(3, 5, 2) * 0
    inside[1, 2, 0] = 99.0
    found = _uncertainty_scores.whole(forecast, TrajectoryDataset.from_arrays(inside))
    assert found == pytest.approx({"state": 5 / 6, "joint": 2 / 3})


def test_experiments_are_drawn_as_a_whole():
    shares = np.repeat([[0.0], [1.0]], 50, axis=0)
    pieces = _uncertainty_scores.bounds(shares, np.arange(100))
    experiments = _uncertainty_scores.bounds(shares, np.repeat([0, 1], 50))
    assert pieces[0][0] > 0.3
    assert [bound[0] for bound in experiments] == [0.0, 1.0]


# -- cells ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fit", ["PE", "T"])
def test_a_cell_scores_raw_and_calibrated_forecasts(small, fit):
    result = _uncertainty_simulated.cell("cartpole", 0.03, None, fit, "quick", 0)
    names = [variant.name for variant in _uncertainty_models.VARIANTS[fit]]
    assert list(result["variants"]) == names
    scores = pd.DataFrame(result["variants"][fit]["scores"])
    sizes = scores.groupby(["kind", "truth", "n_calibration"]).size()
    assert dict(sizes) == {
        ("raw", "observed", N_CALIBRATION): 3,
        ("conformal", "observed", N_CALIBRATION): 3,
        ("conformal", "true", N_CALIBRATION): 3,
        ("variance", "observed", N_CALIBRATION): 3,
        ("set", "observed", 20): 3,
        ("set", "observed", N_CALIBRATION): 3,
    }
    assert scores["coverage90"].between(0, 1).all()
    # the same calibration episodes give the same intervals
    by_kind = scores.groupby(["kind", "n_calibration"])["coverage90"].mean()
    assert by_kind["conformal", N_CALIBRATION] == pytest.approx(
        by_kind["set", N_CALIBRATION], abs=0.1
    )
    whole = pd.DataFrame(result["variants"][fit]["whole"]).set_index("kind")
    assert whole.at["simultaneous", "joint"] >= whole.at["conformal", "joint"]
    assert {line["n_samples"] for line in result["variants"][fit]["samples"]} == {4}


def test_a_noiseless_cell_knows_one_truth(small):
    result = _uncertainty_simulated.cell("cartpole", 0.0, None, "TP", "quick", 0)
    assert {line["truth"] for line in result["variants"]["TP"]["scores"]} == {"observed"}
    assert not result["variants"]["TP"]["samples"]


def test_every_estimator_is_what_its_name_says():
    def of(fit):
        return _uncertainty_models.estimator_of(fit, None, mode="full", seed=0).get_params()

    assert (of("P")["estimator__n_members"], of("PE")["estimator__n_members"]) == (1, 5)
    assert of("P")["estimator__probabilistic"] is True
    assert (of("TP")["estimator__nll_beta"], of("TPE")["estimator__nll_beta"]) == (0.0, 0.5)
    assert (of("TPE")["estimator__n_members"], of("T")["estimator__n_members"]) == (5, 1)
    assert of("T")["estimator__probabilistic"] == "separate"
    assert of("LSTM")["probabilistic"] is True
    assert of("GP, exact")["relabeler__max_rows"] == _uncertainty_models.GP_ROWS
    assert of("GP, sparse")["relabeler__max_rows"] is None
    propagated = {
        v.parameters["propagation"] for v in _uncertainty_models.VARIANTS["PE, propagated"]
    }
    assert propagated == {"ts1", "expectation", "moment", "unscented"}


def test_what_is_optional_is_run_where_it_is_asked_for():
    core = uncertainty.core("full", [0, 1, 2])
    more = uncertainty.optional("full", [0, 1, 2])
    assert {cell["noise"] for cell in core} == {0.0, 0.03}
    assert {cell["noise"] for cell in more} == {0.0, 0.01, 0.1}
    assert {cell["process"] for cell in more} == {None, 0.0, 0.03}
    keys = [tuple(cell.values()) for cell in core + more]
    assert len(set(keys)) == len(keys)
    assert {cell["fit"] for cell in core if cell["task"] == "reacher"} == set(
        _uncertainty_models.VARIANTS
    )


def test_the_run_gives_tables_that_text_and_figures_come_from(small, monkeypatch, tmp_path):
    def cells(self, cells, function, **_):
        return [function(**cell) for cell in cells]

    def no_flights():
        raise OSError("no network")

    monkeypatch.setattr(Run, "cells", cells)
    monkeypatch.setattr(_uncertainty_flights, "flights", no_flights)
    monkeypatch.setattr(uncertainty, "QUICK", ["P", "T"])
    monkeypatch.setattr(uncertainty, "NOISE", (0.03,))
    monkeypatch.setitem(uncertainty.EXAMPLE, "quick", ("cartpole", ["P", "T"]))
    run = Run("uncertainty", "quick", [0], tmp_path, 1, {})
    uncertainty.BENCHMARK._store(run, tmp_path)
    tables = read_tables(tmp_path, "uncertainty")
    assert "flights" not in tables
    text = uncertainty.report(tables)
    assert "### cartpole, 3 % noise" in text
    assert "Not run: real flights (2 cells)." in text
    assert "`--data FOLDER`" in text
    assert "| cartpole, 3 % noise | T | 20 |" in text
    example = tables["example"]
    assert set(example["model"]) == {"P", "P, logged actions", "T"}
    assert example.groupby(["model", "state"])["truth"].size().eq(LENGTH).all()
    figures = uncertainty.draw(tables)
    assert set(figures) == {f"uncertainty-{x}" for x in ("coverage", "crps", "growth", "example")}


# -- text -----------------------------------------------------------------------------------------


def scores_of(covered, crps=(10.0, 10.0), model="P", n_episodes=1000):
    """Made-up scores: raw, then conformal with these coverages, one a seed."""
    return pd.DataFrame(
        [
            {"task": "reacher", "noise": 0.0, "model": model, "seed": seed, "kind": kind}
            | {"truth": "observed", "n_calibration": 200, "first": 1, "last": 5}
            | {"coverage90": value if kind == "conformal" else 0.5, "crps": score, "nll": 0.0}
            | {"n_episodes": n_episodes, "n_diverged": 0}
            for kind, score in zip(("raw", "conformal"), crps, strict=True)
            for seed, value in enumerate(covered)
        ]
    )


@pytest.mark.parametrize(
    ("covered", "crps", "said"),
    [
        ([0.87, 0.91], (10.0, 10.2), ["in 1 of 1 cells", "in 1 of 1."]),
        ([0.87, 0.88], (10.0, 10.0), ["in 0 of 1 cells", "P (1-5: 0.875)"]),
        ([0.9, 0.9], (10.0, 10.3), ["in 1 of 1 cells", "in 0 of 1.", "P (1-5: 1.03)"]),
        # nothing that diverged is called cheap
        ([0.9, 0.9], (INF, INF), ["in 0 of 1.", "P (1-5: nan)"]),
    ],
)
def test_the_target_is_checked_on_the_mean_over_seeds(covered, crps, said):
    text = "\n".join(_uncertainty_page.target(scores_of(covered, crps)))
    for part in said:
        assert part in text


def test_forecasts_of_fewer_episodes_are_counted_apart():
    few = scores_of([0.8, 0.8], model="GP", n_episodes=20)
    text = _uncertainty_page.target(pd.concat([scores_of([0.9, 0.9]), few]))
    assert "in 1 of 1 cells" in text[0]
    assert text[1].startswith("- Forecasts of fewer test episodes")
    assert "in 0 of 1 cells" in text[1]


def test_the_sharpest_model_is_named_by_its_calibrated_score():
    scores = pd.concat([scores_of([0.9], (1.0, 8e-3)), scores_of([0.9], (1e-3, 9e-3), model="T")])
    assert "steps 1-5: P (8) before T (9)" in _uncertainty_page.sharpest(scores)


def test_growth_tells_an_explosion_from_an_error():
    growth = pd.DataFrame(
        [
            {"task": "reacher", "noise": 0.03, "model": "P", "seed": seed, "horizon": h}
            | {"std": std, "error": error}
            for seed in range(3)
            for h, std, error in ((10, 0.01, 0.01), (200, 1.0, 0.02))
        ]
    )
    (line,) = _uncertainty_page.growth_table(growth).to_dict("records")
    assert line["std x (10 to 200)"] == "100"
    assert line["error x"] == "2"
    assert (line["std / error at 10"], line["std / error at 200"]) == ("1", "50")


# -- real flights ---------------------------------------------------------------------------------


def flight_results():
    def line(kind, crps):
        bins = _uncertainty_scores.bins_of(_uncertainty_flights.HORIZON)
        return [
            {"kind": kind, "first": first, "last": last, "n_episodes": 2, "n_diverged": 0}
            | {"coverage90": 0.9, "crps": crps, "nll": 1.0, "low": 0.0, "high": 1.0}
            for first, last in bins
        ]

    return [
        (
            {"model": "P", "fold": fold, "mode": "full", "seed": seed},
            {
                "scores": line("raw", 1.0 + 2 * fold) + line("conformal", 1.0),
                "growth": [{"horizon": 1, "std": 0.1, "error": 0.2}],
                "group": [f"{fold}a", f"{fold}b"],
                "inside": {"raw": np.full((2, 5), 0.5), "conformal": np.full((2, 5), 0.9)},
            },
        )
        for fold in range(2)
        for seed in range(2)
    ]


def test_folds_of_real_flights_are_pooled():
    table = _uncertainty_flights._scores(flight_results())
    raw = table[(table["kind"] == "raw") & (table["seed"] == 0)]
    assert len(raw) == 5
    assert raw["crps"].tolist() == [2.0] * 5
    assert raw["n_episodes"].tolist() == [4] * 5
    assert raw["low"].tolist() == raw["high"].tolist() == [0.5] * 5
    text = "\n".join(_uncertainty_page._flights(table))
    assert "0.9 [0.9, 0.9]" in text
    figure = uncertainty.draw.__globals__["_draw_flights"](table)
    assert len(figure.axes) == 3


@pytest.mark.data
def test_flights_of_an_experiment_are_for_one_purpose(data_folder, monkeypatch):
    monkeypatch.setenv("TRAJLEARN_FLIGHTS", str(data_folder(FOLDER).parent))
    once = _uncertainty_flights.flights()
    monkeypatch.setattr(_uncertainty_flights, "flights", lambda: once)
    tested = []
    for fold in range(_uncertainty_flights.N_FOLDS):
        parts = _uncertainty_flights.parts(fold)
        groups = [set(ds.group.tolist()) for ds in parts]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            assert not groups[i] & groups[j]
        assert set(np.concatenate([ds.lengths for ds in parts[1:]])) == {201}
        tested += sorted(groups[2])
    assert len(set(tested)) == len(tested)
