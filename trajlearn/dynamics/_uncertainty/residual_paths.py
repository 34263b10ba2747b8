"""Correlated noise over horizons and states, from the residuals of whole episodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._uncertainty.calibration import Residuals

__all__ = ["ResidualPaths", "residual_paths"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ResidualPaths:
    """Gaussian paths of variance 1 with the correlation of residual paths.

    With Z_i the standardised residuals of calibration episode i, scaled to a mean square of 1 at
    each horizon and state, and g_i independent standard normal numbers, ``sum_i g_i Z_i /
    sqrt(n)`` is Gaussian with the empirical correlation between all horizons and states: nothing
    is assumed about how errors persist. Where an episode has ended its terms are missing, and n
    is the number of those that are left. The rank of the correlation is at most n.

    Attributes
    ----------
    values : ndarray of shape (n, H, d_s)
        Z_i / sqrt(n).
    logged : ndarray of shape (d_s,)
        States with residuals; each of the others gets a number of its own, constant over
        horizons.
    """

    values: Floats
    logged: NDArray[np.bool_]

    @property
    def reach(self) -> int:
        """Steps they go."""
        return self.values.shape[1]

    def draw(self, rng: np.random.Generator, shape: tuple[int, int], steps: Ints) -> Floats:
        """Independent paths (*shape, len(steps), d_s); beyond the last step they stay."""
        held = self.values[:, np.minimum(steps, self.reach - 1)]
        noise = rng.standard_normal((*shape, len(held)))
        paths: Floats = np.tensordot(noise, held, axes=1)
        if not self.logged.all():
            unknown = rng.standard_normal((*shape, 1, int((~self.logged).sum())))
            paths[..., ~self.logged] = unknown
        return paths


def residual_paths(residuals: Residuals) -> ResidualPaths:
    """Paths of the residuals (one episode or more), to the last step that enough of them reach.

    Diverged cells are left out.
    """
    reach = max(residuals.reach, 1)
    usable = residuals.usable[:, :reach]
    values = np.where(usable, residuals.standardised[:, :reach], 0.0)
    power = np.sqrt((values**2).sum(axis=0))
    values = np.divide(values, power, out=np.zeros_like(values), where=power > 0)
    return ResidualPaths(values, np.asarray(usable.any(axis=(0, 1))))
