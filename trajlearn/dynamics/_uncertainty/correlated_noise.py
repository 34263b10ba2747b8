"""Noise that is correlated along a trajectory: an Ornstein-Uhlenbeck process a state."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["correlated_noise", "correlation_time"]

Floats = NDArray[np.float64]


def correlation_time(residuals: Floats, step: float) -> Floats:
    """Time in which the correlation of residuals (n, H, d), `step` apart, falls to 1/e: (d,)."""
    now, then = residuals[:, :-1], residuals[:, 1:]
    power = np.sqrt((now**2).sum(axis=(0, 1)) * (then**2).sum(axis=(0, 1)))
    correlation = (now * then).sum(axis=(0, 1)) / np.where(power > 0, power, 1.0)
    time: Floats = -step / np.log(np.clip(correlation, 1e-6, 1 - 1e-6))
    return time


def correlated_noise(
    rng: np.random.Generator, n_samples: int, steps: Floats, correlation_times: Floats
) -> Floats:
    """Standard normal numbers (n_samples, n, H, d), correlated along H.

    Parameters
    ----------
    rng : Generator
    n_samples : int
    steps : ndarray of shape (n, H)
        Time since the number before.
    correlation_times : ndarray of shape (d,)
    """
    noise = rng.standard_normal((n_samples, *steps.shape, len(correlation_times)))
    keep = np.exp(-steps[..., None] / correlation_times)
    for k in range(1, steps.shape[1]):
        fresh = np.sqrt(1 - keep[:, k] ** 2) * noise[:, :, k]
        noise[:, :, k] = keep[:, k] * noise[:, :, k - 1] + fresh
    return noise
