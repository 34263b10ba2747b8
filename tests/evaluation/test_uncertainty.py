from types import SimpleNamespace

import numpy as np
import pytest
import scoringrules
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from sklearn.linear_model import BayesianRidge
from sklearn.pipeline import make_pipeline

from tests.evaluation.gaussian_forecasts import RANGE, around, of_numbers, walks
from trajlearn import TrajectoryRegressor
from trajlearn.evaluation import _cells
from trajlearn.evaluation.uncertainty import (
    crps,
    energy_scores,
    interval_hits,
    interval_widths,
    negative_log_likelihood,
    pit_values,
)

INF, NAN = np.inf, np.nan
EVERY = [
    interval_hits,
    interval_widths,
    pit_values,
    crps,
    negative_log_likelihood,
    energy_scores,
]


def cells_of(forecast, ds):
    """(forecast, column, logged state) of every cell that has one."""
    for i in range(len(forecast)):
        e = i if forecast.episode is None else forecast.episode[i]
        for j, horizon in enumerate(forecast.horizons):
            if j < forecast.lengths[i] and forecast.start[i] + horizon <= ds.lengths[e]:
                yield i, j, ds[int(e)].states[forecast.start[i] + horizon]


# -- by hand ------------------------------------------------------------------------------


def test_gaussian_scores_at_known_values():
    forecast, ds = of_numbers([0.0, 2.0, -2.0], mean=0.0, std=2.0, width=4.0)
    # CRPS of N(0, 1): (sqrt 2 - 1) / sqrt pi at 0, 0.6024413 at 1 std
    expected = np.array([(np.sqrt(2) - 1) / np.sqrt(np.pi), 0.602441, 0.602441]) * 0.5
    assert_allclose(crps(forecast, ds).ravel(), expected, rtol=1e-5)
    nll = np.log(0.5 * np.sqrt(2 * np.pi)) + np.array([0, 0.5, 0.5])
    assert_allclose(negative_log_likelihood(forecast, ds).ravel(), nll)
    assert_allclose(pit_values(forecast, ds).ravel(), [0.5, 0.841345, 0.158655], rtol=1e-5)
    # the central interval of level 0.6827 ends at one std
    assert interval_hits(forecast, ds, 0.69).ravel().tolist() == [1, 1, 1]
    assert interval_hits(forecast, ds, 0.68).ravel().tolist() == [1, 0, 0]
    assert_allclose(interval_widths(forecast, ds, 0.6826894921).ravel(), 2 * 2 / 4)


def test_a_point_forecast_is_scored_by_its_error():
    forecast, ds = of_numbers([1.0, 1.5, 0.0], mean=1.0, std=0.0, width=2.0)
    assert_array_equal(crps(forecast, ds).ravel(), [0, 0.25, 0.5])
    assert_array_equal(pit_values(forecast, ds).ravel(), [0.5, 1, 0])
    assert_array_equal(interval_hits(forecast, ds).ravel(), [1, 0, 0])
    assert_array_equal(interval_widths(forecast, ds).ravel(), 0)
    # as if the std were 1e-6 ranges
    nll = np.log(1e-6 * np.sqrt(2 * np.pi)) + np.array([0, 0.25, 0.5]) ** 2 / 2e-12
    assert_allclose(negative_log_likelihood(forecast, ds).ravel(), nll)


def test_sample_scores_at_known_values():
    samples = np.array([[0.0, 1.0, 2.0, 3.0, 4.0]] * 4).T
    forecast, ds = of_numbers([1.0, 2.5, 5.0, -1.0], mean=2.0, samples=samples, width=2.0)
    # mean |x - y| - mean |x - x'| / 2 over different pairs (mean distance 2)
    assert_allclose(crps(forecast, ds).ravel(), np.array([1.4 - 1, 1.3 - 1, 3 - 1, 3 - 1]) / 2)
    # slots: before 0, between 0 and 1, ...
    assert_allclose(pit_values(forecast, ds).ravel(), np.array([2.0, 3.5, 5.5, 0.5]) / 6)
    assert_allclose(interval_widths(forecast, ds, 0.5).ravel(), (3.5 - 0.5) / 2)
    assert interval_hits(forecast, ds, 0.5).ravel().tolist() == [1, 1, 0, 0]
    assert interval_hits(forecast, ds, 0.16).ravel().tolist() == [0, 0, 0, 0]
    assert interval_hits(forecast, ds, 0.17).ravel().tolist() == [0, 1, 0, 0]
    assert interval_hits(forecast, ds, 0.999).ravel().tolist() == [1, 1, 0, 0]
    sigma = samples[:, 0].std(ddof=1)
    nll = stats.norm.logpdf(np.array([1.0, 2.5, 5.0, -1.0]) / 2, 1.0, sigma / 2)
    assert_allclose(negative_log_likelihood(forecast, ds).ravel(), -nll)


def test_samples_that_are_all_the_same_are_a_point():
    forecast, ds = of_numbers([1.0, 2.0], mean=1.0, samples=np.ones((5, 2)))
    assert_array_equal(crps(forecast, ds).ravel(), [0, 1])
    assert_array_equal(interval_hits(forecast, ds, 0.01).ravel(), [1, 0])
    assert_allclose(pit_values(forecast, ds).ravel(), [0.5, 5.5 / 6])


# -- against independent computations -----------------------------------------------------


@given(seed=st.integers(0, 1000), level=st.floats(0.05, 0.99))
def test_every_cell_agrees_with_loops(seed, level):
    rng = np.random.default_rng(seed)
    ds = walks(rng, rng.integers(3, 9, 4))
    starts = [rng.choice(steps, size=rng.integers(1, 3), replace=False) for steps in ds.lengths]
    forecast = around(ds, rng, starts=starts, n_samples=7, diverging=0.3, extra=2)
    found = {f: f(forecast, ds) for f in EVERY[2:]}
    found |= {f: f(forecast, ds, level) for f in EVERY[:2]}
    sampled = {f: f(forecast, ds, distribution="samples") for f in (pit_values, crps)}
    lower, upper = forecast.interval(level)
    seen = np.zeros(forecast.mean.shape[:2], dtype=bool)
    for i, j, y in cells_of(forecast, ds):
        seen[i, j] = True
        if forecast.diverged_at[i] and j + 1 >= forecast.diverged_at[i]:
            assert found[energy_scores][i, j] == INF
            for f, worst in zip(EVERY, (0, INF, NAN, INF, INF)):
                assert_array_equal(found[f][i, j], worst)
            assert_array_equal(sampled[crps][i, j], INF)
            continue
        m, s, x = forecast.mean[i, j], forecast.std[i, j], forecast.samples[:, i, j]
        assert_array_equal(
            found[interval_hits][i, j], (lower[i, j] <= y) & (y <= upper[i, j]), strict=False
        )
        assert_allclose(found[interval_widths][i, j], (upper - lower)[i, j] / RANGE[:2])
        assert_allclose(found[pit_values][i, j], stats.norm.cdf(y, m, s))
        nll = -stats.norm.logpdf(y, m, s) - np.log(RANGE[:2])
        assert_allclose(found[negative_log_likelihood][i, j], nll)
        assert_allclose(found[crps][i, j], scoringrules.crps_normal(y, m, s) / RANGE[:2])
        fair = scoringrules.crps_ensemble(y, x.T, estimator="fair", backend="numpy") / RANGE[:2]
        assert_allclose(sampled[crps][i, j], fair, atol=1e-12)
        assert_allclose(sampled[pit_values][i, j], ((x < y).sum(axis=0) + 0.5) / 8)
        energy = scoringrules.es_ensemble(
            y / RANGE[:2], x / RANGE[:2], estimator="fair", backend="numpy"
        )
        assert_allclose(found[energy_scores][i, j], energy)
    for values in found.values():
        absent = np.isnan(values) if values.ndim == 2 else np.isnan(values).all(axis=2)
        assert absent[~seen].all()
    assert not np.isnan(found[crps][seen]).any()
    assert not np.isnan(found[energy_scores][seen]).any()


def test_chunks_of_forecasts_give_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    ds = walks(rng, [5, 3, 8, 4])
    forecast = around(ds, rng, n_samples=6, with_std=False)
    whole = [f(forecast, ds) for f in EVERY]
    monkeypatch.setattr(_cells, "_CHUNK", 100)
    for f, expected in zip(EVERY, whole):
        assert_array_equal(f(forecast, ds), expected)


def test_many_samples_approach_the_gaussian():
    rng = np.random.default_rng(0)
    ds = walks(rng, [6] * 30)
    forecast = around(ds, rng, n_samples=2000)
    for f, tolerance in ((pit_values, 0.05), (crps, 0.02), (negative_log_likelihood, 0.5)):
        gaussian, sampled = (f(forecast, ds, distribution=d) for d in ("gaussian", "samples"))
        assert_allclose(sampled, gaussian, atol=tolerance)
        assert_allclose(sampled.mean(), gaussian.mean(), atol=tolerance / 10)
    without = forecast._replace(samples=None)
    for level in (0.5, 0.9):
        widths = [interval_widths(of, ds, level).mean() for of in (forecast, without)]
        assert_allclose(*widths, rtol=0.02)


def test_fair_scores_do_not_depend_on_the_number_of_samples():
    rng = np.random.default_rng(1)
    ds = walks(rng, [10] * 200)
    few, many = (around(ds, np.random.default_rng(2), n_samples=n) for n in (3, 100))
    exact = crps(many, ds, distribution="gaussian").mean()
    assert_allclose(crps(few, ds, distribution="samples").mean(), exact, rtol=0.03)
    assert_allclose(crps(many, ds, distribution="samples").mean(), exact, rtol=0.01)
    assert_allclose(energy_scores(few, ds).mean(), energy_scores(many, ds).mean(), rtol=0.03)


def test_the_energy_score_sees_a_correlation_that_single_states_do_not():
    rng = np.random.default_rng(0)
    n, n_samples = 400, 60
    ds = walks(rng, [1] * n)
    forecast = around(ds, rng, n_samples=n_samples)
    # truth and right samples move together in both states, the wrong ones apart
    common = rng.normal(size=(n, 1, 1)) * RANGE[:2]
    forecast.mean = forecast.initial_states[:, None] * 0
    logged = type(ds).from_arrays(np.concatenate([0 * common, common], axis=1))
    drawn = rng.normal(size=(n_samples, n, 1, 1)) * RANGE[:2]
    forecast.samples, forecast.state_names = drawn, logged.state_names
    wrong = forecast._replace(samples=drawn * [1, -1])
    right_crps, wrong_crps = (crps(f, logged, distribution="samples") for f in (forecast, wrong))
    assert_allclose(right_crps.mean(), wrong_crps.mean(), rtol=0.05)
    assert energy_scores(forecast, logged).mean() < 0.9 * energy_scores(wrong, logged).mean()


# -- infinities ---------------------------------------------------------------------------


def test_a_sample_that_diverged_is_an_infinite_score_and_bound():
    samples = np.array([0.0, 1.0, 2.0, 3.0, INF])[:, None]
    forecast, ds = of_numbers(1.5, mean=1.5, samples=samples)
    for f in (crps, negative_log_likelihood, energy_scores):
        assert f(forecast, ds).item() == INF
    assert interval_widths(forecast, ds, 0.9).item() == INF
    assert interval_hits(forecast, ds, 0.9).item() == 1
    assert_allclose(interval_widths(forecast, ds, 0.3).item(), 1.8)
    assert_allclose(pit_values(forecast, ds).item(), 2.5 / 6)


def test_an_infinite_std_promises_nothing():
    forecast, ds = of_numbers([1.0], mean=0.0, std=INF)
    assert crps(forecast, ds).item() == negative_log_likelihood(forecast, ds).item() == INF
    assert interval_widths(forecast, ds).item() == INF
    assert interval_hits(forecast, ds).item() == 1
    assert pit_values(forecast, ds).item() == 0.5


# -- bands, states, arguments -------------------------------------------------------------


def test_intervals_are_those_of_the_forecast_also_with_bands(monkeypatch):
    rng = np.random.default_rng(0)
    ds = walks(rng, [4, 6])
    forecast = around(ds, rng, n_samples=5)
    by_samples = interval_hits(forecast, ds, 0.9)
    assert_allclose(interval_widths(forecast, ds, 0.9), _width(forecast, 0.9), atol=1e-12)
    # bands of infinite width, as ConformalBands beyond their calibration
    forecast.bands = np.full(2, SimpleNamespace(), dtype=object)
    wide = forecast.mean - INF, forecast.mean + INF
    monkeypatch.setattr(type(forecast), "interval", lambda self, level: wide)
    assert (interval_hits(forecast, ds, 0.9)[~np.isnan(by_samples)] == 1).all()
    assert np.isposinf(interval_widths(forecast, ds, 0.9)[~np.isnan(by_samples)]).all()
    # an infinite multiple of a std of 0
    nothing = forecast.mean * NAN, forecast.mean * NAN
    monkeypatch.setattr(type(forecast), "interval", lambda self, level: nothing)
    assert (interval_hits(forecast, ds, 0.9)[~np.isnan(by_samples)] == 1).all()


def _width(forecast, level):
    lower, upper = forecast.interval(level)
    return (upper - lower) / RANGE[:2]


def test_only_states_that_were_forecast_and_logged_count():
    rng = np.random.default_rng(0)
    ds = walks(rng, [4, 6], d_s=3)
    forecast = around(ds, rng, n_samples=5)
    only_z = ds.select_states(["z"])
    for f in EVERY[:-1]:
        assert_array_equal(f(forecast, only_z), f(forecast, ds)[..., 2:])
    assert energy_scores(forecast, only_z).shape == (2, 6)
    assert_allclose(
        energy_scores(forecast, only_z), crps(forecast, only_z, distribution="samples")[..., 0]
    )


def test_a_pipeline_and_its_later_starts(decays, state_selector):
    model = make_pipeline(
        state_selector(["s0"]), TrajectoryRegressor(BayesianRidge(), random_state=0)
    )
    forecast = model.fit(decays[:8]).predict(decays[8:], start=[[0, 7]] * 4, return_std=True)
    scores = crps(forecast, decays[8:])
    assert scores.shape == (8, 20, 1)
    assert np.isfinite(scores[0::2]).all()
    assert np.isfinite(scores[1::2, :13]).all()
    assert np.isnan(scores[1::2, 13:]).all()
    later = model.predict(decays[8:], start=7, return_std=True)
    assert_allclose(crps(later, decays[8:]), scores[1::2, :13])


def test_what_cannot_be_scored_is_refused():
    rng = np.random.default_rng(0)
    ds = walks(rng, [4, 6])
    bare = around(ds, rng, with_std=False)
    for f in (pit_values, crps, negative_log_likelihood):
        with pytest.raises(ValueError, match="no uncertainty"):
            f(bare, ds)
        with pytest.raises(ValueError, match='choose "auto"'):
            f(bare, ds, distribution="normal")
    for f in EVERY[:2]:
        with pytest.raises(ValueError, match="no uncertainty"):
            f(bare, ds)
        for n_samples in (0, 3):
            with pytest.raises(ValueError, match="between 0 and 1"):
                f(around(ds, rng, n_samples=n_samples), ds, 1.0)
    with pytest.raises(ValueError, match="n_samples= at least 2"):
        energy_scores(around(ds, rng), ds)
    with pytest.raises(ValueError, match="n_samples= at least 2"):
        crps(around(ds, rng, n_samples=1), ds, distribution="samples")
    with pytest.raises(ValueError, match="return_std=True"):
        crps(around(ds, rng, n_samples=3, with_std=False), ds, distribution="gaussian")
    with pytest.raises(ValueError, match="2 forecasts, but 1 episodes"):
        crps(around(ds, rng), ds[:1])
    with pytest.raises(ValueError, match="was logged at"):
        crps(around(ds, rng).at([1, 2]), ds.decimate(2))
