"""The uncertainty of a forecaster that gives none: its errors on held-out episodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._selection.entrant import Assessment
from trajlearn.dynamics._selection.losses import kernel_of, knots_of
from trajlearn.dynamics._uncertainty.calibration import Residuals
from trajlearn.dynamics._uncertainty.residual_paths import ResidualPaths, residual_paths

__all__ = ["HeldOutNoise", "noise_of"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class HeldOutNoise:
    """Spread of forecasts, and how it is correlated over horizons and states.

    Attributes
    ----------
    spread : ndarray of shape (H, d_s)
        Root mean square of held-out errors about each step.
    paths : ResidualPaths
    """

    spread: Floats
    paths: ResidualPaths

    def std(self, mean: Floats, steps: Ints) -> Floats:
        """Standard deviation of forecasts (n, k, d_s) of the given steps (k,), from 0."""
        found = self.spread[np.minimum(steps, len(self.spread) - 1)]
        return np.where(np.isfinite(mean), found, mean)

    def draw(self, mean: Floats, steps: Ints, n_samples: int, rng: np.random.Generator) -> Floats:
        """Trajectories about forecasts (n_samples, n, k, d_s)."""
        noise = self.paths.draw(rng, (n_samples, len(mean)), steps)
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(mean), mean + self.std(mean, steps) * noise, mean)


def noise_of(
    assessment: Assessment, state_range: Floats, columns: Ints, bandwidth: float
) -> HeldOutNoise:
    """Noise of a member from its residuals; diverged ones say nothing and are left out.

    Parameters
    ----------
    assessment : Assessment
    state_range : ndarray of shape (2, d_s)
    columns : ndarray of shape (k,)
        States that are logged. Of the others nothing is known, nor of any about steps at which
        all forecasts have diverged: there, the spread is the training range.
    bandwidth : float
    """
    errors = np.full((*assessment.elapsed.shape, state_range.shape[1]), np.nan)
    errors[..., columns] = assessment.residuals
    usable = np.isfinite(errors)
    power = np.where(usable, errors, 0.0) ** 2
    knots = knots_of(errors.shape[1])
    kernel = kernel_of(errors.shape[1], knots, bandwidth)
    # (K, d_s) about each knot
    count = kernel @ usable.sum(axis=0)
    total = kernel @ power.sum(axis=0)
    unknown = np.broadcast_to(np.ptp(state_range, axis=0) ** 2, total.shape)
    mean = np.divide(total, count, out=unknown.copy(), where=count > 0)
    steps = np.log(np.arange(1, errors.shape[1] + 1))
    spread = np.stack([np.interp(steps, np.log(knots), np.sqrt(m)) for m in mean.T], axis=1)
    residuals = Residuals(errors, np.ones_like(errors), assessment.elapsed)
    return HeldOutNoise(spread, residual_paths(residuals))
