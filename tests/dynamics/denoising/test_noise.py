"""Measurement noise in the residuals of one step, and nothing else for it."""

import numpy as np
import pytest

from trajlearn.dynamics._denoising.noise import residual_noise, start_of

EPISODE = np.repeat(np.arange(40), 50)


def residuals(slopes, *, measurement=0.0, process=0.0, seed=0):
    """Of a linear step with the slopes (d, d), known exactly, on noisy states."""
    rng, d = np.random.default_rng(seed), len(slopes)
    v = measurement * rng.normal(size=(40, 51, d))
    e = v[:, 1:] - v[:, :-1] @ np.transpose(slopes) + process * rng.normal(size=(40, 50, d))
    return e.reshape(-1, d), np.broadcast_to(slopes, (2000, d, d))


@pytest.mark.parametrize("slope", [0.9, -0.9])
def test_noise_is_told_whatever_the_sign_of_the_slope(slope):
    found = residual_noise(*residuals([[slope]], measurement=0.3, process=0.2), EPISODE)
    assert found.found.all()
    assert found.measurement[0] == pytest.approx(0.09, rel=0.1)
    assert found.residual[0] == pytest.approx(0.09 * (1 + slope**2) + 0.04, rel=0.1)


def test_each_state_has_noise_of_its_own():
    slopes = [[1.0, 0.2, 0.0], [-0.3, 0.8, 0.1], [0.0, 0.4, 0.9]]
    e, f = residuals(slopes, measurement=np.array([0.3, 0.0, 0.1]), process=0.05)
    found = residual_noise(e, f, EPISODE)
    np.testing.assert_allclose(found.measurement, [0.09, 0.0, 0.01], atol=0.004)
    assert found.found.tolist() == [True, False, True]


def test_a_state_that_forgets_is_seen_in_the_others():
    e, f = residuals([[0.0, 0.0], [0.8, 0.5]], measurement=0.2, process=0.1)
    np.testing.assert_allclose(residual_noise(e, f, EPISODE).measurement, 0.04, rtol=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_process_noise_leaves_no_trace(seed):
    e, f = residuals([[0.95]], process=0.3, seed=seed)
    assert not residual_noise(e, f, EPISODE).found.any()


@pytest.mark.parametrize("memory", [0.8, -0.8])
def test_what_lasts_longer_than_a_step_is_no_noise(memory):
    rng = np.random.default_rng(0)
    e = rng.normal(size=(40, 50, 1))
    for t in range(1, 50):
        e[:, t] += memory * e[:, t - 1]
    flat = e.reshape(-1, 1)
    found = residual_noise(flat, np.full((2000, 1, 1), 0.95), EPISODE)
    assert not found.found.any()


def test_noise_that_explains_little_is_left_alone():
    e, f = residuals([[0.9]], measurement=0.1, process=1.0)
    assert not residual_noise(e, f, EPISODE).found.any()


def test_residuals_of_different_episodes_are_not_neighbours():
    alternating = np.tile([[1.0], [-1.0]], (1000, 1))
    found = residual_noise(alternating, np.ones((2000, 1, 1)), np.arange(2000))
    assert not found.found.any()


def test_too_few_residuals_say_nothing():
    found = residual_noise(np.ones((2, 1)), np.ones((2, 1, 1)), np.zeros(2))
    assert not found.found.any()


def test_the_start_of_another_episode():
    rng = np.random.default_rng(0)
    means = rng.multivariate_normal([1.0, -1.0], [[1.0, 0.6], [0.6, 2.0]], size=400)
    unsure = np.tile(0.1 * np.eye(2), (400, 1, 1))
    mean, covariance = start_of(means, unsure, np.array([1e4, 1e4]))
    np.testing.assert_allclose(mean, [1.0, -1.0], atol=0.2)
    np.testing.assert_allclose(covariance, [[1.1, 0.6], [0.6, 2.1]], rtol=0.25)
    # of few episodes it is wider, of next to none it says nothing
    assert np.trace(start_of(means[:6], unsure[:6], np.array([1e4, 1e4]))[1]) > np.trace(
        np.cov(means[:6].T)
    )
    np.testing.assert_array_equal(
        start_of(means[:4], unsure[:4], np.array([3.0, 4.0]))[1], np.diag([3.0, 4.0])
    )
