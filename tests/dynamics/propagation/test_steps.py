"""One step of a Gaussian, and the small matrices behind it."""

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

from trajlearn.dynamics._rollouts.rollout import Limits
from trajlearn.dynamics.propagation._algebra import (
    applied,
    nearest_semidefinite,
    product,
    root_of,
    transposed,
    whitened,
)
from trajlearn.dynamics.propagation._gaussians import Transition, roll_gaussians
from trajlearn.dynamics.propagation._steps import linearised, sigma_weights, unscented


def covariances(d, rank, n=5, seed=0):
    half = np.random.default_rng(seed).normal(size=(n, d, rank))
    return half @ half.swapaxes(1, 2)


def test_products_are_those_of_matrices():
    rng = np.random.default_rng(0)
    left, right, vector = (
        rng.normal(size=shape) for shape in ((3, 4, 2, 5), (4, 5, 3), (6, 3, 4, 5))
    )
    np.testing.assert_allclose(product(left, right), left @ right)
    np.testing.assert_allclose(applied(left, vector), (left @ vector[..., None])[..., 0])


@pytest.mark.parametrize("d", [1, 2, 5])
@pytest.mark.parametrize("rank", [0, 1, 2, 5])
def test_roots_of_singular_covariances(d, rank):
    wanted = covariances(d, rank)
    root = root_of(wanted)
    np.testing.assert_allclose(product(root, transposed(root)), wanted, atol=1e-12)
    np.testing.assert_array_equal(root, np.tril(root))
    if rank >= d:
        np.testing.assert_allclose(root, np.linalg.cholesky(wanted))
    # u is what the root was applied to, where the root has columns
    u = np.random.default_rng(1).normal(size=(7, 5, d)) * (np.abs(root) > 0).any(axis=-2)
    np.testing.assert_allclose(whitened(root, applied(root, u)), u, atol=1e-6)


def test_round_off_in_a_perfect_correlation_is_not_taken_for_spread():
    a, b = 1.0, 1e-6
    wanted = np.array([[a * a, a * b], [a * b, b * b * (1 + 1e-14)]])
    root = root_of(wanted)
    assert root[1, 1] == 0.0
    assert whitened(root, np.array([1.0, b])).tolist() == [1.0, 0.0]


def test_a_matrix_with_negative_eigenvalues_is_mended_and_no_other():
    good = covariances(3, 3, n=2)
    values, vectors = np.linalg.eigh(good[0])
    bad = (vectors * (values - values[1])) @ vectors.T
    infinite = np.full((3, 3), np.inf)
    found = nearest_semidefinite(np.stack([good[0], bad, infinite, good[1]]))
    np.testing.assert_allclose(found[[0, 3]], good)
    assert np.linalg.eigvalsh(found[1])[0] > -1e-12
    expected = (vectors * np.maximum(values - values[1], 0)) @ vectors.T
    np.testing.assert_allclose(found[1], expected, atol=1e-12)
    assert np.isposinf(found[2]).all()


def bent(points, k):
    """A map that is bent in all directions, with a variance that depends on the state."""
    x = points
    means = np.sin(x + k) + 0.3 * x * np.roll(x, 1, axis=-1)
    return means, 0.1 + 0.05 * x**2


@pytest.mark.parametrize("d", [1, 2, 3, 4, 6])
def test_sigma_points_are_those_of_filterpy(d):
    rng = np.random.default_rng(d)
    mean, covariance = rng.normal(size=(2, 3, d)), 0.1 * np.stack([covariances(d, d, 3)] * 2)
    found = unscented(bent, d)(mean, root_of(covariance), 2)
    for e in range(2):
        for i in range(3):
            chosen = MerweScaledSigmaPoints(d, alpha=1.0, beta=0.0, kappa=max(3 - d, 0))
            points = chosen.sigma_points(mean[e, i], covariance[e, i])
            means, variances = bent(points, 2)
            noise = np.diag(chosen.Wm @ variances)
            centre, spread = unscented_transform(means, chosen.Wm, chosen.Wc, noise)
            cross = (points - mean[e, i]).T @ (chosen.Wc[:, None] * (means - centre))
            gain = found.gain[e, i]
            np.testing.assert_allclose(found.mean[e, i], centre, atol=1e-12)
            np.testing.assert_allclose(gain @ gain.T + found.noise[e, i], spread, atol=1e-12)
            # gain u is the best linear guess of the next state from this one
            root = np.linalg.cholesky(covariance[e, i])
            np.testing.assert_allclose(gain @ root.T, cross.T, atol=1e-12)
            assert np.linalg.eigvalsh(found.noise[e, i])[0] > 0


@pytest.mark.parametrize("d", range(1, 20))
def test_no_sigma_point_has_a_negative_weight(d):
    for_mean, for_covariance = sigma_weights(d)
    assert min(for_mean.min(), for_covariance.min()) >= 0
    assert np.isclose(for_mean.sum(), 1.0)


def test_sigma_points_get_the_mean_and_the_spread_of_a_square_right():
    mean, variance = np.array([[[0.7]]]), np.array([[[[0.4]]]])
    found = unscented(lambda x, k: (x**2, np.zeros_like(x)), 1)(mean, root_of(variance), 0)
    np.testing.assert_allclose(found.mean, 0.7**2 + 0.4)
    spread = found.gain**2 + found.noise
    np.testing.assert_allclose(spread, 4 * 0.7**2 * 0.4 + 2 * 0.4**2)


def test_slopes_are_the_derivatives_at_the_mean():
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(2, 4, 3))
    found = linearised(bent, np.array([1.0, 2.0, 0.5]))(
        mean, np.broadcast_to(np.eye(3), (2, 4, 3, 3)), 1
    )
    means, variances = bent(mean, 1)
    np.testing.assert_array_equal(found.mean, means)
    np.testing.assert_allclose(found.noise, variances[..., None] * np.eye(3))
    jacobian = np.zeros((2, 4, 3, 3))
    for i in range(3):
        before = (i - 1) % 3
        jacobian[..., i, i] = np.cos(mean[..., i] + 1) + 0.3 * mean[..., before]
        jacobian[..., i, before] += 0.3 * mean[..., i]
    np.testing.assert_allclose(found.gain, jacobian, atol=1e-6)


def test_a_member_that_fails_takes_its_start_along_and_no_other():
    def step(mean, root, k):
        after = mean + 1.0
        noise = np.broadcast_to(0.01 * np.eye(1), (*mean.shape, 1)).copy()
        if k == 2:
            after[1, 0] = np.nan  # the mean of one member
            noise[0, 1] = np.inf  # the covariance of another
        return Transition(after, root, noise)

    limits = Limits(None, np.zeros(1), np.full(1, 100.0))
    rolled = roll_gaussians(
        np.zeros((3, 1)), 5, 2, step, limits, n_samples=8, rng=np.random.default_rng(0)
    )
    steps = np.arange(1.0, 6)
    np.testing.assert_allclose(rolled.mean[1:, :, 0], [steps, steps])
    np.testing.assert_array_equal(rolled.mean[0, :, 0], [1, 2, np.inf, np.inf, np.inf])
    size = 0.1 * np.sqrt(steps)
    np.testing.assert_allclose(rolled.std[2, :, 0], size)
    for i in (0, 1):
        np.testing.assert_allclose(rolled.std[i, :2, 0], size[:2])
        assert np.isposinf(rolled.std[i, 2:]).all()
        # half of the paths are of the member that failed
        assert np.isposinf(rolled.samples[:, i, 2:, 0]).all(axis=1).sum() == 4
    assert np.isfinite(rolled.samples[:, 2]).all()
    assert not np.isnan(rolled.samples).any()
