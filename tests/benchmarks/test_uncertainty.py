"""The study of uncertainty: its cells on a few short episodes, its text on made-up tables."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import (
    _models,
    _tasks,
    _uncertainty_flights,
    _uncertainty_growth,
    _uncertainty_models,
    _uncertainty_page,
    _uncertainty_scores,
    _uncertainty_simulated,
    _uncertainty_tables,
    _uncertainty_target,
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
    monkeypatch.setitem(_uncertainty_models.PARTICLES, "quick", 3)
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
    for fit, variants in _uncertainty_models.VARIANTS.items():
        model = _uncertainty_models.estimator_of(fit, None, mode="full", seed=0)
        for variant in variants:
            parameters = model.set_params(**variant.parameters).get_params()
            drawn = parameters.get("propagation", "tsinf") not in ("moment", "unscented")
            expected = parameters.get("n_particles") if drawn else None
            assert variant.particles("full") == expected
        assert {variant.name for variant in variants} <= set(_uncertainty_models.DESCRIPTIONS)
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
    assert "recorded flights (`--data FOLDER`): real flights (2 cells)." in text
    assert "fewer steps: reacher, 3 % noise (9 cells); cartpole, 3 % noise (7 cells);" in text
    assert "GP, sparse, moment" not in text
    assert "3 particles (P; P, logged actions)" in text
    assert "| cartpole, 3 % noise | T | 20 |" in text
    example = tables["example"]
    assert set(example["model"]) == {"P", "P, logged actions", "T"}
    assert example.groupby(["model", "state"])["truth"].size().eq(LENGTH).all()
    figures = uncertainty.draw(tables)
    assert set(figures) == {f"uncertainty-{x}" for x in ("coverage", "crps", "growth", "example")}


# -- text -----------------------------------------------------------------------------------------


def scores_of(covered, crps=(10.0, 10.0), nll=(0.0, 0.0), model="P", n_episodes=1000):
    """Made-up scores: raw, then conformal with these coverages, one a seed."""
    return pd.DataFrame(
        [
            {"task": "reacher", "noise": 0.0, "model": model, "seed": seed, "kind": kind}
            | {"truth": "observed", "n_calibration": 200, "first": 1, "last": 5}
            | {"coverage90": value if kind == "conformal" else 0.5, "crps": score, "nll": of_nll}
            | {"n_episodes": n_episodes, "n_diverged": 0}
            for kind, score, of_nll in zip(("raw", "conformal"), crps, nll, strict=True)
            for seed, value in enumerate(covered)
        ]
    )


def target_of(*scores):
    """Line of each size in the table of the target, and the exceptions."""
    lines = _uncertainty_target.target(pd.concat(scores))
    rows = [line.strip("| ").split(" | ") for line in lines[2].split("\n")[2:]]
    return {row[0]: row[1:5] for row in rows}, "\n".join(lines[4:])


@pytest.mark.parametrize(
    ("covered", "crps", "nll", "met", "said"),
    [
        ([0.87, 0.91], (10.0, 10.2), (1.0, 0.9), (1, 1, 1), ""),
        ([0.87, 0.88], (10.0, 10.0), (0.0, 0.0), (0, 1, 1), "P (1-5: 0.875)"),
        ([0.9, 0.9], (10.0, 10.3), (-1.0, -1.0), (1, 0, 1), "P (1-5: 1.03)"),
        ([0.9, 0.9], (10.0, 10.0), (-1.0, -0.8), (1, 1, 0), "P (1-5: +0.2)"),
        # nothing that diverged is called cheap
        ([0.9, 0.9], (INF, INF), (INF, INF), (1, 0, 0), "P (1-5: infinite before and after)"),
    ],
)
def test_the_target_is_checked_on_the_mean_over_seeds(covered, crps, nll, met, said):
    rows, exceptions = target_of(scores_of(covered, crps, nll))
    ((inside, alone, cheap, no_worse),) = rows.values()
    assert (inside, cheap, no_worse) == tuple(f"{n} of 1" for n in met)
    assert alone == f"{sum(0.88 <= value <= 0.92 for value in covered)} of 2"
    assert said in exceptions


def test_forecasts_of_fewer_episodes_are_counted_apart():
    few = scores_of([0.8, 0.8], model="GP", n_episodes=20)
    rows, _ = target_of(scores_of([0.9, 0.9]), few)
    assert [row[0] for row in rows.values()] == ["1 of 1", "0 of 1"]
    assert list(rows) == ["200 / 1000", "200 / 20"]


def test_chance_is_that_of_exchangeable_residuals():
    rng = np.random.default_rng(0)
    # exactly valid: the 46th of 50 residuals is the half width, rank ceil(51 * 0.9)
    bound = np.sort(rng.uniform(size=(20_000, 50)), axis=1)[:, 45]
    covered = (rng.uniform(size=(20_000, 40)) < bound[:, None]).mean(axis=1)
    found = _uncertainty_target.chance(50, 40, 2)
    assert found.std == pytest.approx(covered.std(), rel=0.03)
    inside = [
        ((some >= 0.88 - 1e-9) & (some <= 0.92 + 1e-9)).mean()
        for some in (covered, covered.reshape(-1, 2).mean(axis=1))
    ]
    assert (found.one, found.several) == pytest.approx(inside, abs=0.015)
    assert _uncertainty_target.chance(5, 40, 2).one == 0.0


def test_few_particles_of_a_perfect_model_cover_less():
    rng = np.random.default_rng(0)
    particles, truth = rng.normal(size=(100_000, 10)), rng.normal(size=100_000)
    inside = np.abs(truth) <= 1.6449 * particles.std(axis=1)
    assert _uncertainty_target.perfect_coverage(10) == pytest.approx(inside.mean(), abs=0.005)
    assert _uncertainty_target.perfect_coverage(10**6) == pytest.approx(0.9, abs=1e-4)


def test_the_sharpest_model_is_named_by_its_calibrated_score():
    scores = [scores_of([0.9], (1.0, 8e-3)), scores_of([0.9], (1e-3, 9e-3), model="T")]
    # they know more, or less was asked of them
    scores.append(scores_of([0.9], (1.0, 1e-3), model="P, logged actions"))
    scores.append(scores_of([0.9], (1.0, 1e-3), model="GP", n_episodes=20))
    assert "1-5: P (8) before T (9)." in _uncertainty_tables.sharpest(pd.concat(scores))
    scores.append(scores_of([0.9], (1.0, 8.01e-3), model="PE"))
    assert "1-5: P and PE equal (8)." in _uncertainty_tables.sharpest(pd.concat(scores))
    (lost,) = [scores_of([0.9], (INF, INF))]
    assert "1-5: all are infinite." in _uncertainty_tables.sharpest(lost)


def test_divergence_is_counted_over_all_seeds():
    scores = pd.concat([scores_of([0.9, 0.9, 0.9]), scores_of([0.9, 0.9, 0.9], model="T")])
    assert _uncertainty_tables.diverged(scores) == []
    scores.loc[(scores["seed"] == 1) & (scores["model"] == "T"), "n_diverged"] = 3
    (_, line) = _uncertainty_tables.diverged(scores)
    assert line.endswith("T: 3 of 3000.")


def test_quality_shows_the_range_over_bins_and_hides_nothing():
    scores = pd.concat([scores_of([0.9, 0.9]).assign(first=f, last=f + 4) for f in (1, 6)])
    scores = scores.assign(spread_skill=np.where(scores["first"] == 1, 0.5, 2.0))
    scores = scores.assign(error_std_correlation=0.5, calibration_error=[np.nan, *[0.1] * 7])
    raw, conformal = _uncertainty_page._quality(scores).to_dict("records")
    assert raw["spread / error"] == "0.5 to 2"
    assert raw["calibration error"].startswith("nan")
    assert conformal["calibration error"] == "0.1 (0.1 to 0.1)"


def test_small_sets_have_their_interval_and_range():
    sets = scores_of([0.8, 0.9]).assign(kind="set", n_calibration=20, low=[0.7, 0.8] * 2, high=0.95)
    text = "\n".join(_uncertainty_page._small(sets[2:]))
    assert "| P | 20 | 0.85 [0.75, 0.95] (0.8 to 0.9) |" in text


# -- growth ---------------------------------------------------------------------------------------


def growth_of(*ends, model="P", task="reacher"):
    """Growth with this std and error at 10 and 200 steps, in each of three seeds."""
    return pd.DataFrame(
        [
            {"task": task, "noise": 0.03, "model": model, "seed": seed, "horizon": h}
            | {"std": std, "error": error}
            for seed in range(3)
            for h, (std, error) in zip((10, 200), ends, strict=True)
        ]
    )


def test_growth_tells_an_explosion_from_an_error():
    (line,) = _uncertainty_growth.growth_table(growth_of((0.01, 0.01), (1.0, 0.02))).to_dict(
        "records"
    )
    assert line["std x (10 to 200)"] == "100"
    assert line["error x"] == "2"
    assert (line["std / error at 10"], line["std / error at 200"]) == ("1", "50")


def test_the_verdict_follows_from_the_growth_by_rule():
    small = (0.01, 0.01)
    growth = pd.concat(
        [
            growth_of(small, (1.0, 0.02)),
            growth_of(small, (0.2, 0.11), model="PE"),
            growth_of(small, (1.0, 0.9), model="P, logged actions"),
            growth_of(small, (0.01, 0.021), model="T"),
            growth_of(small, (INF, INF), model="TP"),
            growth_of(small, (9.0, 9.0), model="LSTM"),
            growth_of(small, (1.0, 1.0), task="real"),
        ]
    )
    lines = _uncertainty_growth.verdict(growth)
    assert lines[-2:] == [
        "- reacher, 3 % noise (10 to 200): std grows faster than the error: P (x 100, error x 2); "
        "std grows with the error: PE (x 20, error x 11), P, logged actions (x 100, error x 90); "
        "std grows more slowly than the error: T (x 1, error x 2.1); "
        "diverged: TP (diverged, error diverged).",
        "- real flights (10 to 200): std grows with the error: P (x 100, error x 100).",
    ]
    rows = [line.strip("| ").split(" | ") for line in lines[2].split("\n")[2:]]
    # forecasts, std explodes, the error too; faster, with, more slowly, diverged
    assert {row[0]: "".join(row[1:]) for row in rows} == {
        "one-step, logged actions": "2220200",
        "one-step, actions recomputed": "2211100",
        "trajectory": "2110011",
    }


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
    assert raw["n_groups"].tolist() == [4] * 5
    text = "\n".join(_uncertainty_page._flights(table))
    assert "0.9 [0.9, 0.9]" in text
    assert text.startswith("4 pieces of 4 experiments: forecasts of 200 steps, one every 50")
    assert "about 2 experiments" in text
    figure = uncertainty.draw.__globals__["_draw_flights"](table)
    assert len(figure.axes) == 3


def test_what_has_no_value_in_one_fold_has_none_at_all():
    results = flight_results()
    results[0][1]["scores"][0]["crps"] = np.nan
    results[0][1]["scores"][1]["crps"] = INF
    table = _uncertainty_flights._scores(results)
    first = table[(table["kind"] == "raw") & (table["seed"] == 0)]["crps"]
    np.testing.assert_array_equal(first, [np.nan, INF, 2.0, 2.0, 2.0])


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
