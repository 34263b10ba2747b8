from itertools import product

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from sklearn.linear_model import BayesianRidge

from tests.evaluation.gaussian_forecasts import RANGE, around, walks
from trajlearn import HoldForecaster, TrajectoryDataset, TrajectoryRegressor
from trajlearn.dynamics.calibrated import CalibratedForecaster
from trajlearn.evaluation.calibration import calibration_report, pit_histogram, reliability
from trajlearn.evaluation.uncertainty import (
    crps,
    energy_scores,
    interval_hits,
    interval_widths,
    negative_log_likelihood,
    pit_values,
)

INF, NAN = np.inf, np.nan
COLUMNS = ["first", "last", "state", "measure", "level", "value", "low", "high"]


LEVELS = {"levels": (0.5, 0.9, 0.95)}


def report_of(forecast, ds, **arguments):
    return calibration_report(
        forecast, ds, **LEVELS | {"n_bootstrap": 0, "random_state": 0} | arguments
    )


def pick(table, state="all", first=1, **keys):
    chosen = table[(table["state"] == state) & (table["first"] == first)]
    for name, value in keys.items():
        chosen = chosen[chosen[name] == value]
    assert len(chosen) == 1
    return chosen.iloc[0]


def value(table, measure, *, level=None, **keys):
    level = {} if level is None else {"level": level}
    return pick(table, measure=measure, **level, **keys)["value"]


# -- what is known of a Gaussian ----------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    rng = np.random.default_rng(0)
    ds = walks(rng, [10] * 1000)
    return ds, rng.bit_generator.seed_seq.spawn(3)


@pytest.mark.parametrize("n_samples", [0, 199])
def test_a_calibrated_forecast_is_found_calibrated(many, n_samples):
    ds = many[0] if not n_samples else many[0][:150]
    forecast = around(ds, np.random.default_rng(1), n_samples=n_samples, with_std=not n_samples)
    report = report_of(forecast, ds, bins=[(1, 10)])
    n_cells = 2 * len(ds) * 10
    for level in (0.5, 0.9, 0.95):
        found = value(report, "coverage", level=level)
        assert abs(found - level) < 4 * np.sqrt(level * (1 - level) / n_cells)
    assert value(report, "calibration_error") < 0.015
    assert_allclose(value(report, "spread_skill"), 1, atol=0.03)
    # E CRPS = std / sqrt(pi), E NLL = log std + log(2 pi e) / 2
    std = np.random.default_rng(1).uniform(0.05, 0.2, size=(len(ds), 10, 2))
    assert_allclose(value(report, "crps"), std.mean() / np.sqrt(np.pi), rtol=0.03)
    nll = np.log(std).mean() + 0.5 * np.log(2 * np.pi * np.e)
    assert_allclose(value(report, "nll"), nll, atol=0.02)
    histogram = pit_histogram(forecast, ds, bins=[(1, 10)], n_bootstrap=0)
    pooled = histogram[histogram["state"] == "all"]
    assert_allclose(pooled["value"], 1, atol=4 * np.sqrt(0.1 / n_cells) * 10)
    assert_allclose(pooled["value"].mean(), 1)


def test_too_sure_by_a_factor_of_two_covers_what_a_gaussian_says(many):
    ds = many[0]
    forecast = around(ds, np.random.default_rng(1), factor=0.5)
    report = report_of(forecast, ds, bins=[(1, 10)])
    for level in (0.5, 0.9, 0.95):
        true = 2 * stats.norm.cdf(stats.norm.ppf(0.5 + level / 2) / 2) - 1
        assert_allclose(value(report, "coverage", level=level), true, atol=0.015)
    assert_allclose(value(report, "spread_skill"), 0.5, atol=0.02)
    levels = np.arange(1, 20) / 20
    gaps = levels - (2 * stats.norm.cdf(stats.norm.ppf(0.5 + levels / 2) / 2) - 1)
    assert_allclose(value(report, "calibration_error"), gaps.mean(), atol=0.01)
    table = pit_histogram(forecast, ds, n_bins=4, bins=[(1, 10)], n_bootstrap=0)
    edges = stats.norm.cdf(stats.norm.ppf(np.arange(5) / 4) / 2)
    assert_allclose(table[table["state"] == "x"]["value"], 4 * np.diff(edges), atol=0.08)


def test_the_correlation_of_a_calibrated_forecast(many):
    ds = many[0]
    forecast = around(ds, np.random.default_rng(1))
    std = np.random.default_rng(5).uniform(0.05, 0.2, size=100_000)
    error = np.abs(np.random.default_rng(6).normal(size=len(std)) * std)
    expected = stats.spearmanr(error, std).statistic
    report = report_of(forecast, ds, bins=[(1, 10)])
    assert_allclose(value(report, "error_std_correlation"), expected, atol=0.03)
    shuffled = forecast[:]
    shuffled.std = (
        np.random.default_rng(0).permutation(forecast.std.ravel()).reshape(forecast.std.shape)
    )
    assert abs(value(report_of(shuffled, ds), "error_std_correlation")) < 0.05


def test_few_samples_still_give_a_flat_histogram(many):
    ds = many[0][:300]
    forecast = around(ds, np.random.default_rng(1), n_samples=6, with_std=False)
    table = pit_histogram(forecast, ds, n_bins=10, bins=[(1, 10)], n_bootstrap=0)
    assert_allclose(table[table["state"] == "all"]["value"], 1, atol=0.1)


# -- against loops ------------------------------------------------------------------------


LOOPED = [0.3, 0.8, *(float(level) for level in np.round(np.arange(1, 20) / 20, 2))]


def scores_of(forecast, ds):
    """Every score of every cell, and the energy score."""
    cells = {
        "crps": crps(forecast, ds),
        "nll": negative_log_likelihood(forecast, ds),
        "std": forecast.std / RANGE[: forecast.std.shape[2]],
        "squared": forecast.squared_errors(ds),
    }
    for p in LOOPED:
        cells["hit", p] = interval_hits(forecast, ds, p)
    for p in LOOPED[:2]:
        cells["width", p] = interval_widths(forecast, ds, p)
    return cells, None if forecast.samples is None else energy_scores(forecast, ds)


def by_loops(forecast, ds, scores, columns, first, last):
    """Every measure of one bin, cell by cell."""
    cells, joint = scores
    found = {name: [] for name in cells}
    energy, episodes, gone = [], set(), set()
    for i, j in product(range(len(forecast)), range(len(forecast.horizons))):
        e = i if forecast.episode is None else int(forecast.episode[i])
        horizon = forecast.horizons[j]
        reached = j < forecast.lengths[i] and forecast.start[i] + horizon <= ds.lengths[e]
        if not first <= horizon <= last or not reached:
            continue
        episodes.add(e)
        if 0 < forecast.diverged_at[i] <= j + 1:
            gone.add(e)
        for name, values in cells.items():
            found[name].extend(values[i, j, columns])
        if joint is not None:
            energy.append(joint[i, j])
    found = {name: np.array(values) for name, values in found.items()}
    settled = np.isfinite(found["squared"])
    rmse = np.sqrt(found["squared"].mean())
    spread = np.sqrt((found["std"][settled] ** 2).mean()) if settled.any() else NAN
    gaps = [abs(found["hit", p].mean() - p) for p in LOOPED[2:]]
    measures = {
        ("crps", None): found["crps"].mean(),
        ("nll", None): found["nll"].mean(),
        ("spread_skill", None): 0.0 if np.isinf(rmse) else spread / rmse,
        ("calibration_error", None): np.mean(gaps),
        ("error_std_correlation", None): _spearman(
            found["squared"][settled], found["std"][settled]
        ),
    }
    for p in LOOPED[:2]:
        measures["coverage", p] = found["hit", p].mean()
        measures["width", p] = found["width", p].mean()
    if energy:
        measures["energy_score", None] = np.mean(energy)
    return measures, len(episodes), len(gone)


def _spearman(x, y):
    if len(x) < 2:
        return NAN
    return stats.spearmanr(x, y).statistic


@settings(max_examples=8)
@given(
    seed=st.integers(0, 1000),
    diverging=st.sampled_from([0.0, 0.3]),
    n_samples=st.sampled_from([0, 5]),
)
def test_every_row_agrees_with_loops(seed, diverging, n_samples):
    rng = np.random.default_rng(seed)
    ds = walks(rng, rng.integers(3, 9, 5))
    starts = [rng.choice(steps, size=rng.integers(1, 3), replace=False) for steps in ds.lengths]
    forecast = around(
        ds, rng, starts=starts, n_samples=n_samples, diverging=diverging, extra=seed % 2
    )
    bins = [(1, 1), (2, 3), (1, 3)] if forecast.horizons[-1] > 1 else [(1, 1)]
    report = report_of(forecast, ds, levels=[0.3, 0.8], bins=bins)
    scores = scores_of(forecast, ds)
    assert len(report) == len(bins) * (3 * 9 + bool(n_samples))
    for (first, last), (state, columns) in product(
        bins, {"all": [0, 1], "x": [0], "y": [1]}.items()
    ):
        measures, n_episodes, n_diverged = by_loops(forecast, ds, scores, columns, first, last)
        here = report[report["last"] == last]
        for (measure, level), expected in measures.items():
            if measure == "energy_score" and state != "all":
                continue
            keys = {"measure": measure} | ({} if level is None else {"level": level})
            row = pick(here, state, first, **keys)
            assert_allclose(row["value"], expected, atol=1e-10, err_msg=f"{measure} {state}")
            assert row["n_episodes"] == n_episodes
            assert row["n_diverged"] == n_diverged


def test_a_std_that_is_the_same_everywhere_has_no_correlation():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7], d_s=1)
    forecast = around(ds, rng)
    forecast.std = np.where(np.isnan(forecast.mean), NAN, 0.3)
    report = report_of(forecast, ds, n_bootstrap=50)
    rows = report[report["measure"] == "error_std_correlation"]
    assert rows[["value", "low", "high"]].isna().all(axis=None)


def test_a_resample_without_spread_has_no_correlation():
    # one std an episode: of two, only a resample of both has two of them
    rng = np.random.default_rng(0)
    ds = walks(rng, [3, 7], d_s=1)
    forecast = around(ds, rng)
    forecast.std = np.array([0.1, 0.3])[:, None, None] * np.ones_like(forecast.std)
    row = pick(
        report_of(forecast, ds, n_bootstrap=50, bins=[(1, 7)]), measure="error_std_correlation"
    )
    assert_allclose([row["low"], row["high"]], row["value"])


def test_ranks_put_an_infinite_std_highest():
    rng = np.random.default_rng(0)
    ds = walks(rng, [1] * 30, d_s=1)
    forecast = around(ds, rng)
    errors = np.abs(forecast.residuals(ds))
    forecast.std = np.where(errors == errors.max(), INF, np.exp(100 * errors))
    report = report_of(forecast, ds)
    assert_allclose(value(report, "error_std_correlation"), 1)
    assert value(report, "spread_skill") == INF


# -- shape of the tables ------------------------------------------------------------------


def test_columns_bins_and_attributes():
    rng = np.random.default_rng(0)
    ds = walks(rng, [30, 28])
    forecast = around(ds, rng, n_samples=3)
    forecast.actions = "logged"
    report = report_of(forecast, ds, truth_kind="true", n_bootstrap=3)
    assert list(report) == [*COLUMNS, "n_episodes", "n_diverged"]
    assert report.attrs == {
        "truth": "true",
        "actions": "logged",
        "calibrated": False,
        "distribution": "gaussian",
        "confidence": 0.95,
        "n_bootstrap": 3,
        "units": "training ranges",
    }
    bins = list(zip(report["first"], report["last"]))
    assert list(dict.fromkeys(bins)) == [(1, 5), (6, 25), (26, 30)]
    assert report["state"].unique().tolist() == ["all", "x", "y"]
    assert (report.groupby("measure")["level"].nunique() == 3).sum() == 2
    joint = report[report["measure"] == "energy_score"]
    assert set(joint["state"]) == {"all"}
    assert "energy_score" not in set(report_of(forecast._replace(samples=None), ds)["measure"])
    assert pick(report, first=26, measure="crps")["n_episodes"] == 2
    without = report_of(forecast._replace(std=None), ds)
    assert without.attrs["distribution"] == "samples"


def test_every_horizon_by_itself_and_chosen_ones():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6])
    forecast = around(ds, rng)
    report = report_of(forecast, ds, bins=None, levels=[0.5])
    assert (report["first"] == report["last"]).all()
    assert report["first"].unique().tolist() == list(range(1, 10))
    found = report[(report["state"] == "y") & (report["measure"] == "crps")]
    scores = crps(forecast, ds)[..., 1]
    assert_allclose(found["value"], np.nanmean(scores, axis=0))
    assert found["n_episodes"].tolist() == [2] * 6 + [1] * 3
    some = report_of(forecast.at([2, 7]), ds, bins=None, levels=[0.5])
    kept = report[report["first"].isin([2, 7])].reset_index(drop=True)
    pd.testing.assert_frame_equal(some, kept)


def test_rows_of_a_state_are_those_of_its_forecast_alone():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7], d_s=3)
    forecast = around(ds, rng, diverging=0.3)
    arguments = {"n_bootstrap": 20, "bins": [(1, 9)]}
    whole = report_of(forecast, ds, **arguments)
    alone = report_of(forecast, ds.select_states(["y"]), **arguments)
    drop = {"columns": "state"}
    expected = whole[whole["state"] == "y"].drop(**drop).reset_index(drop=True)
    for state in ("all", "y"):
        found = alone[alone["state"] == state].drop(**drop).reset_index(drop=True)
        pd.testing.assert_frame_equal(found, expected)


def test_pooled_scores_are_the_mean_of_those_of_the_states():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7], d_s=3)
    report = report_of(around(ds, rng), ds)
    table = report[report["measure"].isin(["coverage", "width", "crps", "nll"])]
    table = table.fillna({"level": 0}).pivot_table(
        index=["first", "measure", "level"], columns="state", values="value"
    )
    assert_allclose(table["all"], table[["x", "y", "z"]].mean(axis=1))


@settings(max_examples=12)
@given(seed=st.integers(0, 1000), factor=st.floats(0.01, 100))
def test_units_and_the_order_of_episodes_do_not_matter(seed, factor):
    rng = np.random.default_rng(seed)
    ds = walks(rng, rng.integers(3, 9, 5))
    forecast = around(ds, rng, n_samples=4, diverging=0.2)
    expected = report_of(forecast, ds)
    scaled = forecast._replace(
        mean=forecast.mean * factor,
        std=forecast.std * factor,
        samples=forecast.samples * factor,
        state_range=forecast.state_range * factor,
    )
    same = TrajectoryDataset.from_arrays(
        [episode.states * factor for episode in ds], state_names=ds.state_names
    )
    pd.testing.assert_frame_equal(report_of(scaled, same), expected)
    order = rng.permutation(len(ds))
    moved = forecast[order]
    pd.testing.assert_frame_equal(report_of(moved, ds[order]), expected)


# -- bootstrap ----------------------------------------------------------------------------


def test_the_bootstrap_interval_is_about_the_value_and_narrows_with_episodes(many):
    widths = []
    for n in (50, 800):
        ds = many[0][:n]
        forecast = around(ds, np.random.default_rng(3))
        report = report_of(forecast, ds, bins=[(1, 10)], n_bootstrap=200)
        rows = report[report["measure"] != "calibration_error"]
        assert (rows["low"] < rows["value"]).all()
        assert (rows["value"] < rows["high"]).all()
        widths.append((report["high"] - report["low"]).to_numpy())
    assert_allclose(np.median(widths[0] / widths[1]), 4, atol=1)


def test_the_bootstrap_covers_the_truth_as_often_as_it_says():
    found = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        ds = walks(rng, [4] * 40, d_s=1)
        table = reliability(around(ds, rng), ds, levels=[0.7], random_state=seed, confidence=0.8)
        found.append((table["low"] <= 0.7) & (table["high"] >= 0.7))
    assert abs(np.mean(found) - 0.8) < 0.12


def test_episodes_are_resampled_whole():
    # in each episode everything is inside or everything outside: 60 forecasts are 20 facts
    rng = np.random.default_rng(0)
    ds = walks(rng, [10] * 20, d_s=1)
    forecast = around(ds, rng, starts=[[0, 2, 4]] * 20)
    inside = np.repeat(np.arange(20) % 2 == 0, 3)
    forecast.std = np.where(inside[:, None, None], 1e3, 1e-9) * np.ones_like(forecast.std)
    forecast.std[np.isnan(forecast.mean)] = NAN
    row = pick(
        report_of(forecast, ds, levels=[0.9], n_bootstrap=2000, bins=[(1, 3)]), measure="coverage"
    )
    assert row["value"] == 0.5
    expected = stats.binom(20, 0.5).ppf([0.025, 0.975]) / 20
    assert_allclose([row["low"], row["high"]], expected, atol=0.051)


def test_bounds_survive_divergence_and_say_nothing_of_one_episode():
    rng = np.random.default_rng(0)
    ds = walks(rng, [3] * 20 + [9])
    forecast = around(ds, rng)
    forecast.mean[:2, 1:] = forecast.std[:2, 1:] = INF
    forecast.diverged_at[:2] = 2
    report = report_of(forecast, ds, n_bootstrap=100, bins=[(1, 1), (2, 3), (4, 9)])
    score = pick(report, first=2, measure="crps")
    assert score["value"] == score["high"] == INF
    assert score["n_diverged"] == 2
    assert np.isfinite(score["low"])
    assert value(report, "spread_skill", first=2) == 0
    assert np.isfinite(value(report, "error_std_correlation", first=2))
    covered = pick(report, first=2, measure="coverage", level=0.95)
    assert covered["value"] <= 19 / 21
    assert np.isfinite([covered["low"], covered["high"]]).all()
    assert np.isfinite(report[report["first"] == 1][["value", "low", "high"]]).all(axis=None)
    alone = report[report["first"] == 4]
    assert (alone["n_episodes"] == 1).all()
    assert alone[["low", "high"]].isna().all(axis=None)
    assert alone["value"].notna().all()


def test_seeds_decide_the_bootstrap_and_zero_leaves_it_out():
    rng = np.random.default_rng(0)
    ds = walks(rng, [4] * 10)
    forecast = around(ds, rng)
    first, again, other = (
        report_of(forecast, ds, n_bootstrap=30, random_state=seed) for seed in (1, 1, 2)
    )
    pd.testing.assert_frame_equal(first, again)
    assert not np.allclose(first["low"], other["low"])
    assert_array_equal(first["value"], other["value"])
    assert report_of(forecast, ds)[["low", "high"]].isna().all(axis=None)
    narrow = report_of(forecast, ds, n_bootstrap=30, random_state=1, confidence=0.5)
    assert ((narrow["high"] - narrow["low"]) <= (first["high"] - first["low"])).all()


# -- reliability, histogram, bands --------------------------------------------------------


def test_reliability_is_the_coverage_of_the_report():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7])
    forecast = around(ds, rng, n_samples=9)
    table = reliability(forecast, ds, levels=[0.5, 0.9], random_state=0, n_bootstrap=20)
    report = report_of(forecast, ds, levels=[0.5, 0.9], n_bootstrap=20)
    expected = report[report["measure"] == "coverage"].reset_index(drop=True)
    pd.testing.assert_frame_equal(table, expected)
    whole = reliability(forecast, ds, n_bootstrap=0)
    pooled = whole[(whole["state"] == "x") & (whole["first"] == 1)]
    gap = (pooled["value"] - pooled["level"]).abs().mean()
    assert_allclose(gap, value(report_of(forecast, ds), "calibration_error", state="x"))


@given(seed=st.integers(0, 1000), n_samples=st.sampled_from([0, 4]))
def test_the_histogram_agrees_with_loops(seed, n_samples):
    rng = np.random.default_rng(seed)
    ds = walks(rng, rng.integers(3, 9, 5))
    forecast = around(ds, rng, n_samples=n_samples, with_std=not n_samples, diverging=0.2)
    table = pit_histogram(forecast, ds, n_bins=3, bins=[(1, 2)], n_bootstrap=0)
    pit = pit_values(forecast, ds)
    present = ~np.isnan(forecast.squared_errors(ds))
    for state, columns in {"all": [0, 1], "y": [1]}.items():
        mass, count = np.zeros(3), 0
        for i, j, k in product(range(len(ds)), range(2), columns):
            count += present[i, j, k]
            if np.isnan(pit[i, j, k]):
                continue
            if not n_samples:
                mass[min(int(3 * pit[i, j, k]), 2)] += 1
                continue
            low, high = pit[i, j, k] + np.array([-0.5, 0.5]) / (n_samples + 1)
            for b in range(3):
                overlap = min(high, (b + 1) / 3) - max(low, b / 3)
                mass[b] += max(overlap, 0) / (high - low)
        rows = table[table["state"] == state]
        assert rows["left"].tolist() == [0, 1 / 3, 2 / 3]
        assert_allclose(rows["value"], 3 * mass / count, atol=1e-12)


def test_bands_decide_the_intervals_and_the_gaussian_the_scores(monkeypatch):
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7])
    plain = around(ds, rng, n_samples=9)
    forecast = plain._replace(bands=np.full(3, "bands", dtype=object), raw_std=plain.std)
    # bands as wide as a fifth of the level
    monkeypatch.setattr(
        type(forecast),
        "interval",
        lambda self, level: (
            self.mean - 0.1 * level * RANGE[:2],
            self.mean + 0.1 * level * RANGE[:2],
        ),
    )
    report = report_of(forecast, ds, levels=[0.5])
    assert report.attrs["calibrated"]
    assert_allclose(value(report, "width", level=0.5), 0.1)
    inside = np.sqrt(plain.squared_errors(ds)) <= 0.05
    known = ~np.isnan(plain.squared_errors(ds))
    known[:, 5:] = False
    assert_allclose(value(report, "coverage", level=0.5), inside[known].mean())
    for measure in ("crps", "nll", "spread_skill", "energy_score"):
        assert value(report, measure) == value(report_of(plain, ds), measure)


def test_a_calibrated_forecaster():
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(120, 1, 1)) * np.linspace(0, 1, 11)[:, None]
    ds = TrajectoryDataset.from_arrays(slopes + 0.01 * rng.normal(size=slopes.shape))
    model = CalibratedForecaster(HoldForecaster(), cv=0.5, random_state=0).fit(ds[:80])
    report = report_of(model.predict(ds[80:], return_std=True), ds[80:], n_bootstrap=100)
    assert report.attrs["calibrated"]
    found = pick(report, first=6, measure="coverage", level=0.9)
    assert found["low"] <= 0.9 <= found["high"]


def test_the_distribution_can_be_chosen():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6, 7])
    forecast = around(ds, rng, n_samples=9)
    without = report_of(forecast._replace(std=None), ds)
    pd.testing.assert_frame_equal(report_of(forecast, ds, distribution="samples"), without)
    assert value(without, "crps") != value(report_of(forecast, ds), "crps")
    tables = [
        pit_histogram(f, ds, n_bootstrap=0, distribution=d)
        for f, d in ((forecast, "samples"), (forecast._replace(std=None), "auto"))
    ]
    pd.testing.assert_frame_equal(*tables)


# -- arguments ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"levels": [0.5, 1.0]}, "levels = .* between 0 and 1"),
        ({"levels": []}, "levels"),
        ({"bins": "fine"}, 'must be "standard"'),
        ({"bins": []}, 'must be "standard"'),
        ({"bins": [1, 5]}, "list of .first, last."),
        ({"bins": [(1, 5), (20, 30)]}, r"no horizon from 20 to 30 .* 1\.\.9"),
        ({"truth_kind": "noisy"}, 'choose "observed" or "true"'),
        ({"n_bootstrap": -1}, "n_bootstrap = -1"),
        ({"confidence": 1.0}, "confidence = 1.0"),
        ({"distribution": "laplace"}, 'choose "auto"'),
        ({"distribution": "samples"}, "n_samples= at least 2"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6])
    with pytest.raises(ValueError, match=message):
        calibration_report(around(ds, rng), ds, **arguments)


def test_forecasts_without_uncertainty_and_bad_histograms_are_refused():
    rng = np.random.default_rng(0)
    ds = walks(rng, [9, 6])
    for function in (calibration_report, reliability, pit_histogram):
        with pytest.raises(ValueError, match="no uncertainty"):
            function(around(ds, rng, with_std=False), ds)
        with pytest.raises(ValueError, match="2 forecasts, but 1 episodes"):
            function(around(ds, rng), ds[:1])
    for n_bins in (1, 2.5, True):
        with pytest.raises(ValueError, match="n_bins"):
            pit_histogram(around(ds, rng), ds, n_bins=n_bins)
    with pytest.raises(ValueError, match="levels"):
        reliability(around(ds, rng), ds, levels=[0.0])


def test_a_real_model_with_several_starts(decays):
    model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(decays[:8])
    forecast = model.predict(decays[8:], start=[[0, 5]] * 4, return_std=True)
    report = report_of(forecast, decays[8:], n_bootstrap=20)
    assert (report["n_episodes"] == 4).all()
    assert report["value"].notna().all()
