"""The batched smoother: the numbers of filterpy, episode by episode."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from trajlearn.dynamics._denoising.smoother import Problem, smooth_states

RNG = np.random.default_rng(0)
F = 0.5 * RNG.normal(size=(3, 3))
SHIFT = RNG.normal(size=3)
Q, R = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.7])
MEAN, COVARIANCE = RNG.normal(size=3), 0.4 * np.eye(3) + 0.1
COUNTS = np.array([12, 3, 7, 12, 1])
MEASURED = RNG.normal(size=(12, 5, 2))


def problem(states):
    """x' = F x + SHIFT, the first two of three numbers measured, linearised at `states`."""
    known = np.arange(12)[:, None] < COUNTS
    slopes = np.broadcast_to(F, (11, 5, 3, 3))
    return Problem(MEASURED, known, states, states[:-1] @ F.T + SHIFT, slopes)


def smoothed(states=None, **changed):
    states = np.zeros((12, 5, 3)) if states is None else states
    noise = {"measurement": R, "process": Q, "start_mean": MEAN, "start_covariance": COVARIANCE}
    return smooth_states(problem(states), **(noise | changed))


def filtered(measured):
    """Means and covariances by filterpy's filter, and the log likelihood."""
    kalman = KalmanFilter(3, 2, dim_u=3)
    kalman.F, kalman.B, kalman.H = F, np.eye(3), np.eye(3)[:2]
    kalman.Q, kalman.R = np.diag(Q), np.diag(R)
    kalman.x, kalman.P = MEAN.copy(), COVARIANCE.copy()
    means, covariances, likelihood = [], [], 0.0
    for t, y in enumerate(measured):
        if t:
            kalman.predict(u=SHIFT)
        kalman.update(y)
        likelihood += kalman.log_likelihood
        means.append(kalman.x.copy())
        covariances.append(kalman.P.copy())
    return kalman, np.array(means), np.array(covariances), likelihood


def reference(i):
    """Smoothed means and covariances of an episode by filterpy, and the log likelihood."""
    kalman, means, covariances, likelihood = filtered(MEASURED[: COUNTS[i], i])
    # filterpy's smoother knows no input: it smooths deviations from a path without noise
    path = [np.zeros(3)]
    for _ in range(len(means) - 1):
        path.append(F @ path[-1] + SHIFT)
    found, spread, _, _ = kalman.rts_smoother(means - np.array(path), covariances)
    return found + np.array(path), spread, likelihood


@pytest.mark.parametrize("i", range(5))
def test_means_and_covariances_are_those_of_filterpy(i):
    posterior = smoothed()
    mean, covariance, _ = reference(i)
    np.testing.assert_allclose(posterior.mean[: COUNTS[i], i], mean, atol=1e-12)
    np.testing.assert_allclose(posterior.covariance[: COUNTS[i], i], covariance, atol=1e-12)


def test_the_likelihood_is_that_of_the_innovations():
    total = sum(reference(i)[2] for i in range(5))
    assert smoothed().deviance == pytest.approx(-2 * total, rel=1e-12)


def test_a_linear_step_may_be_linearised_anywhere():
    moved = smoothed(RNG.normal(size=(12, 5, 3)))
    here = np.arange(12)[:, None] < COUNTS
    np.testing.assert_allclose(moved.mean[here], smoothed().mean[here], atol=1e-12)
    assert moved.deviance == pytest.approx(smoothed().deviance, rel=1e-12)


def test_expected_noise_is_the_slope_of_the_likelihood():
    posterior, step = smoothed(), 1e-5
    for name, variance, squares, count in (
        ("measurement", R, posterior.missed, posterior.n_measured),
        ("process", Q, posterior.pushed, posterior.n_steps),
    ):
        for j in range(len(variance)):
            ahead, behind = variance.copy(), variance.copy()
            ahead[j] *= np.exp(step)
            behind[j] *= np.exp(-step)
            change = smoothed(**{name: ahead}).deviance - smoothed(**{name: behind}).deviance
            assert change / (2 * step) == pytest.approx(count - squares[j] / variance[j], rel=1e-5)
