"""Pieces of calibration by themselves: factors, ranks, steps, correlated noise."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scoringrules import crps_normal

from trajlearn.dynamics._uncertainty.calibration import Rescaling, Residuals, crps_rescaling
from trajlearn.dynamics._uncertainty.conformal import (
    half_widths,
    marginal_bands,
    simultaneous_bands,
    steps_of,
)
from trajlearn.dynamics._uncertainty.held_out import splits
from trajlearn.dynamics._uncertainty.residual_paths import residual_paths
from trajlearn.exceptions import CalibrationWarning
from trajlearn.trajectories import TrajectoryDataset


def residuals(errors, std=1.0):
    errors = np.asarray(errors, dtype=float)
    elapsed = np.tile(0.1 * np.arange(1, errors.shape[1] + 1), (len(errors), 1))
    return Residuals(errors, np.broadcast_to(std, errors.shape).astype(float), elapsed)


def best(errors, std):
    """Factor of least CRPS, found without derivatives."""

    def crps(log_factor):
        return crps_normal(errors, 0.0, np.exp(log_factor) * std).mean()

    return np.exp(minimize_scalar(crps, bounds=(-10, 10), method="bounded").x)


def as_given(n_steps, d_s):
    return Rescaling(np.ones((n_steps, d_s)), np.zeros((n_steps, d_s)))


# -- the factor on the standard deviation, and the floor ----------------------------------


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e5])
def test_the_factor_has_the_least_crps(heavy, size):
    rng = np.random.default_rng(0)
    errors = rng.standard_cauchy((50, 3, 2)) if heavy else rng.normal(size=(50, 3, 2))
    # rows of one std leave nothing for a floor to do
    std = np.broadcast_to(size * np.array([0.5, 2.0, 1.0])[:, None], errors.shape)
    found = crps_rescaling(residuals(errors * [1.0, 3.0] * size, std))
    np.testing.assert_array_equal(found.floor, 0)
    for h in range(3):
        for j, scale in enumerate((1.0, 3.0)):
            expected = best(errors[:, h, j] * scale, std[:, h, j] / size)
            np.testing.assert_allclose(found.factor[h, j], expected, rtol=1e-4)


@pytest.mark.parametrize("noise", [0.0, 1.0, 5.0])
def test_a_floor_stands_for_what_the_model_does_not_know(noise):
    rng = np.random.default_rng(0)
    std = np.exp(rng.normal(size=(4000, 1, 1)))
    errors = 2 * std * rng.normal(size=std.shape) + noise * rng.normal(size=std.shape)
    found = crps_rescaling(residuals(errors, std))
    np.testing.assert_allclose(found.factor, 2, rtol=0.25)
    # from a coarse grid
    np.testing.assert_allclose(found.floor, noise, rtol=0.4, atol=0.1)
    z = errors / found.of(std, np.array([0]))
    np.testing.assert_allclose((np.abs(z) < 1.645).mean(), 0.9, atol=0.03)
    for small in (std < 0.5, std > 2):
        np.testing.assert_allclose((np.abs(z[small]) < 1.645).mean(), 0.9, atol=0.05)


def test_rows_without_std_do_not_say_how_high_the_floor_is():
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(300, 1, 1))
    for share in (0.2, 0.5):
        std = np.where(rng.uniform(size=errors.shape) < share, 1e-9, 0.5)
        rescaled = crps_rescaling(residuals(errors, std)).of(std, np.array([0]))
        np.testing.assert_allclose(rescaled, 1.0, atol=0.2)


def test_nearly_always_exact_is_not_certain():
    rng = np.random.default_rng(0)
    errors = np.where(rng.uniform(size=(100, 4, 1)) < 0.2, 1.0, 0.0)
    found = crps_rescaling(residuals(errors))
    np.testing.assert_allclose(found.factor, 0.2, atol=0.15)


def test_an_infinite_std_stays_infinite():
    rescaling = Rescaling(np.full((2, 1), 0.5), np.ones((2, 1)))
    std = np.array([[np.inf], [np.nan]])
    np.testing.assert_array_equal(rescaling.of(std, np.arange(2)), std)


@pytest.mark.parametrize("band", ["marginal", "simultaneous"])
def test_bands_of_an_infinite_std_are_infinite(band):
    # an error of 0 standard deviations, where nothing is known, must not shrink the others
    calibration = residuals(
        np.full((9, 1, 1), 2.0), np.array([np.inf] * 5 + [1.0] * 4)[:, None, None]
    )
    bands = (
        marginal_bands(calibration, np.ones(1))
        if band == "marginal"
        else simultaneous_bands(calibration, as_given(1, 1), np.ones(1))
    )
    widths = bands.at(0.3, np.array([0]), np.array([[[np.inf]], [[1.0]]]))
    np.testing.assert_array_equal(widths.ravel(), [np.inf, 0.0])


def test_a_floor_never_costs_crps():
    rng = np.random.default_rng(0)
    for _ in range(20):
        errors, std = rng.standard_t(3, size=(30, 2, 1)), np.exp(rng.normal(size=(30, 2, 1)))
        found = crps_rescaling(residuals(errors, std)).of(std, np.arange(2))
        for h in range(2):
            alone = best(errors[:, h, 0], std[:, h, 0]) * std[:, h, 0]
            with_floor = crps_normal(errors[:, h, 0], 0.0, found[:, h, 0]).mean()
            assert with_floor < crps_normal(errors[:, h, 0], 0.0, alone).mean() * (1 + 1e-6)


def test_far_horizons_share_their_factor():
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(20, 100, 1)) * np.sqrt(np.arange(1, 101))[:, None]
    std = np.sqrt(np.arange(1, 101))[:, None] / 2
    found = crps_rescaling(residuals(errors, std)).factor[:, 0]
    own = [best(errors[:, h, 0], np.full(20, std[h, 0])) for h in range(100)]
    np.testing.assert_allclose(found[:9], own[:9], rtol=1e-4)
    # of the 20 steps around it, which are independent here
    pooled = best(errors[:, 45:55, 0], np.broadcast_to(std[45:55, 0], (20, 10)))
    np.testing.assert_allclose(found[49], pooled, rtol=0.03)
    np.testing.assert_allclose(found[40:], 2.0, rtol=0.2)
    assert np.std(own[40:]) > 3 * np.std(found[40:])


def test_outliers_hardly_widen():
    errors = np.random.default_rng(0).normal(size=(100, 1, 1))
    errors[:5] = 1e6
    factor = crps_rescaling(residuals(errors)).factor[0, 0]
    assert 1.0 < factor < 1.5
    errors[:5] = np.inf
    with_diverged, without = (crps_rescaling(residuals(e)) for e in (errors, errors[5:]))
    np.testing.assert_allclose(with_diverged.factor, without.factor)


def test_perfect_forecasts_have_a_tiny_factor():
    found = crps_rescaling(residuals(np.zeros((10, 3, 2))))
    assert ((found.factor > 0) & (found.factor < 1e-9)).all()
    assert (found.floor < 1e-9).all()


def test_a_few_long_episodes_do_not_decide():
    errors = np.random.default_rng(0).normal(size=(30, 8, 2))
    errors[4:, 5:] = np.nan
    errors[:4, 5:] *= 100
    errors[..., 1] = np.nan
    found = crps_rescaling(residuals(errors)).factor
    np.testing.assert_array_equal(found[5:, 0], found[4, 0])
    np.testing.assert_array_equal(found[:, 1], 1.0)
    assert residuals(errors).reach == 5
    # where all are few, they have to do
    assert residuals(errors[:4]).reach == 8


# -- ranks --------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "level", "rank"), [(9, 0.9, 9), (99, 0.55, 55), (20, 0.5, 11)])
def test_the_rank_corrects_for_the_new_episode(n, level, rank):
    scores = np.random.default_rng(0).permutation(np.arange(1.0, n + 1))[:, None, None]
    elapsed, one = np.ones(1), np.array([0])
    for bands in (
        marginal_bands(residuals(scores), elapsed),
        simultaneous_bands(residuals(scores), as_given(1, 1), elapsed),
    ):
        np.testing.assert_array_equal(bands.multiples(level, one), [[rank]])
        std = np.array([[[2.0]], [[0.5]]])
        np.testing.assert_array_equal(bands.at(level, one, std).ravel(), [2 * rank, rank / 2])
        assert np.isinf(bands.multiples(1 - 1e-6, one)).all()
        assert np.isinf(bands.multiples(level, np.array([1, 5]))).all()


def test_ragged_scores_are_counted_by_horizon():
    scores = np.array([[[3.0], [9.0]], [[-1.0], [np.nan]], [[2.0], [np.nan]]])
    bands = marginal_bands(residuals(scores), np.array([1.0, 2.0]))
    np.testing.assert_array_equal(bands.multiples(0.5, np.array([0, 1]))[:, 0], [2.0, 9.0])
    np.testing.assert_array_equal(bands.multiples(0.75, np.array([0, 1]))[:, 0], [3.0, np.inf])
    assert repr(bands) == "ConformalBands(marginal, n=3, H=2, d_s=1)"


def test_the_largest_score_counts_in_units_of_the_modulation():
    scores = np.array([[[1.0, 8.0], [6.0, np.nan]], [[2.0, 4.0], [np.nan, np.nan]]])
    # the second state was never logged at the second step, but at the first
    modulation = Rescaling(np.array([[1.0, 4.0], [2.0, 3.0]]), np.array([[0.0, 0.0], [0.0, 4.0]]))
    bands = simultaneous_bands(residuals(scores), modulation, np.array([1.0, 2.0]))
    np.testing.assert_array_equal(bands.scores, [2.0, 3.0])
    widths = bands.at(0.3, np.array([0, 1]), np.ones((1, 2, 2)))
    np.testing.assert_array_equal(widths, 2 * np.array([[[1.0, 4.0], [2.0, 5.0]]]))


def test_simultaneous_bands_end_with_the_longest_episode():
    errors = np.random.default_rng(0).normal(size=(20, 6, 2))
    errors[:, 4:] = np.nan
    bands = simultaneous_bands(residuals(errors), as_given(6, 2), np.arange(1.0, 7.0))
    widths = bands.multiples(0.5, np.arange(6))
    assert np.isfinite(widths[:4]).all()
    assert np.isinf(widths[4:]).all()


def test_nobody_is_warned_of_states_that_were_never_logged(recwarn):
    errors = np.random.default_rng(0).normal(size=(20, 3, 2))
    errors[..., 1] = np.nan
    bands = np.full(2, marginal_bands(residuals(errors), np.arange(1.0, 4.0)), dtype=object)
    half_widths(bands, 0.5, np.ones((2, 3, 2)), np.arange(1, 4), np.array([3, 3]))
    assert not recwarn.list
    with pytest.warns(CalibrationWarning, match="3 of 3 horizons"):
        half_widths(bands, 0.99, np.ones((2, 3, 2)), np.arange(1, 4), np.array([3, 3]))


def test_a_state_that_was_never_logged_has_no_band():
    scores = np.array([[[1.0, np.nan]], [[2.0, np.nan]]])
    elapsed = np.ones(1)
    for bands in (
        marginal_bands(residuals(scores), elapsed),
        simultaneous_bands(residuals(scores), as_given(1, 2), elapsed),
    ):
        np.testing.assert_array_equal(bands.multiples(0.5, np.array([0])), [[2.0, np.inf]])


# -- horizons -----------------------------------------------------------------------------


def test_steps_of_horizons():
    elapsed = np.array([0.1, 0.2, 0.3])
    assert steps_of(np.array([1, 3, 7]), elapsed).tolist() == [0, 2, 6]
    times = np.array([0.05, 0.1, 0.1 + 1e-9, 0.15, 0.2999999, 0.3000001, 0.4])
    assert steps_of(times, elapsed).tolist() == [0, 0, 0, 1, 2, 2, 3]


def test_forecasts_of_two_calibrations():
    one, other = (
        marginal_bands(residuals(np.full((n, 2, 1), size)), np.array([1.0, 2.0]))
        for n, size in ((9, 1.0), (4, 2.0))
    )
    bands = np.array([one, other, one], dtype=object)
    horizons, lengths = np.array([1, 2]), np.array([2, 2, 1])
    std = np.array([1.0, 1.0, 3.0])[:, None, None] * np.ones((3, 2, 1))
    found = half_widths(bands, 0.8, std, horizons, lengths)[..., 0]
    np.testing.assert_array_equal(found, [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    with pytest.warns(CalibrationWarning, match=r"2 of 2 .* at level 0.9 bands need 9 .*n=4"):
        half_widths(bands, 0.9, std, horizons, lengths)


# -- noise --------------------------------------------------------------------------------


def test_noise_has_the_correlation_of_the_residuals():
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(12, 1, 2)) + 0.5 * rng.normal(size=(12, 5, 2))
    paths = residual_paths(residuals(errors, 0.1))
    steps = np.arange(5)
    drawn = paths.draw(rng, (20_000, 1), steps)
    assert drawn.shape == (20_000, 1, 5, 2)
    flat = errors.reshape(12, -1) / np.sqrt((errors**2).mean(axis=0)).ravel()
    expected = flat.T @ flat / 12
    found = drawn.reshape(20_000, -1)
    np.testing.assert_allclose(found.T @ found / 20_000, expected, atol=0.03)
    np.testing.assert_array_equal(
        paths.draw(np.random.default_rng(1), (1, 1), np.array([4, 5, 99]))[..., [0, 0, 0], :],
        paths.draw(np.random.default_rng(1), (1, 1), np.array([4, 5, 99])),
    )


def test_noise_of_ragged_and_diverged_episodes_has_variance_one():
    errors = np.random.default_rng(0).normal(size=(40, 6, 1)) * np.arange(1.0, 7.0)[:, None]
    errors[:20, 4:] = np.nan
    errors[25, 2:] = np.inf
    paths = residual_paths(residuals(errors))
    np.testing.assert_allclose((paths.values**2).sum(axis=0), 1.0)
    assert np.isfinite(paths.values).all()
    assert (paths.values[25, 2:] == 0).all()


def test_a_state_that_was_never_logged_has_noise_of_its_own():
    errors = np.random.default_rng(0).normal(size=(40, 3, 2)) + 2.0
    errors[..., 1] = np.nan
    errors = np.concatenate([errors, errors[..., 1:]], axis=2)
    paths = residual_paths(residuals(errors))
    rng = np.random.default_rng(0)
    drawn = paths.draw(rng, (20_000, 1), np.arange(3)).reshape(20_000, 9)
    expected = np.kron(np.ones((3, 3)), np.diag([0, 1.0, 1.0]))
    values = paths.values[..., 0]
    expected[::3, ::3] = values.T @ values
    np.testing.assert_allclose(drawn.T @ drawn / 20_000, expected, atol=0.03)


# -- episodes -----------------------------------------------------------------------------


def dataset(n, group=None):
    return TrajectoryDataset.from_arrays(np.zeros((n, 3, 1)), group=group)


@pytest.mark.parametrize(
    ("n", "cv", "held_out"), [(10, 0.2, 2), (30, 0.1, 3), (10, 0.01, 1), (3, 0.9, 2)]
)
def test_the_share_held_out(n, cv, held_out):
    ((train, test),) = splits(dataset(n), cv, np.random.default_rng(0))
    assert len(test) == held_out
    assert sorted([*train, *test]) == list(range(n))


@pytest.mark.parametrize("cv", [None, 5])
def test_folds_keep_groups_whole(cv):
    labels = np.repeat(list("abcdefg"), 3)
    folds = list(splits(dataset(21, labels), cv, np.random.default_rng(0)))
    assert len(folds) == 5
    for train, test in folds:
        assert not set(labels[train]) & set(labels[test])
    assert sorted(np.concatenate([test for _, test in folds])) == list(range(21))
