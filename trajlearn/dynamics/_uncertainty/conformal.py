"""Split-conformal bands by horizon, with the episode as the exchangeable unit.

Each calibration episode gives one score: for marginal bands one a horizon and state, the error
in predicted standard deviations [1, 2, 5]; for simultaneous bands the largest of these over all
its steps and states, each in units of a modulation so that no horizon dominates [3]. The k-th
smallest of n scores, k = ceil((n + 1) level), covers a new episode with a probability of at
least `level`, whatever the model and the noise, if the n + 1 episodes are exchangeable [1, 2].
With continuous scores the coverage, given the calibration episodes, has the distribution
Beta(k, n + 1 - k) [4]. If k > n the band is infinite.

Why not a library: MAPIE conformalises regressors of one output whose unit is the row, and its
methods for time series assume one long series; crepes gives intervals of one number a row.
Neither has a score per episode, ragged lengths, or a maximum over horizons and outputs. What
remains of split-conformal prediction then is sorting the scores.

References
----------
[1] Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", Springer (2005).
[2] Lei, G'Sell, Rinaldo, Tibshirani and Wasserman, "Distribution-free predictive inference for
    regression", JASA 113 (2018).
[3] Diquigiovanni, Fontana and Vantini, "Conformal prediction bands for multivariate functional
    data", Journal of Multivariate Analysis 189 (2022).
[4] Vovk, "Conditional validity of inductive conformal predictors", ACML (2012).
[5] Stankeviciute, Alaa and van der Schaar, "Conformal time-series forecasting", NeurIPS (2021);
    they cover all horizons at once by Bonferroni's inequality, the maximum [3] is sharper.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._uncertainty.calibration import Rescaling, Residuals
from trajlearn.exceptions import CalibrationWarning

__all__ = ["ConformalBands", "half_widths", "marginal_bands", "simultaneous_bands", "steps_of"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class ConformalBands:
    """Widths of intervals by horizon and state, at any level.

    Attributes
    ----------
    scores : ndarray of shape (n, H, d_s), or (n,) for simultaneous bands
        Increasing; NaN behind those of the episodes that reach a horizon.
    modulation : Rescaling
        Of the model's standard deviations, to the unit of the scores.
    logged : ndarray of shape (H, d_s)
        Where there is a score at all; elsewhere bands are infinite.
    elapsed : ndarray of shape (H,)
        Time from the start to each step.
    """

    scores: Floats
    modulation: Rescaling
    logged: NDArray[np.bool_]
    elapsed: Floats

    @property
    def band(self) -> str:
        """``"marginal"`` or ``"simultaneous"``."""
        return "simultaneous" if self.scores.ndim == 1 else "marginal"

    def __repr__(self) -> str:
        n_steps, d_s = self.logged.shape
        return f"ConformalBands({self.band}, n={len(self.scores)}, H={n_steps}, d_s={d_s})"

    def at(self, level: float, steps: Ints, std: Floats) -> Floats:
        """Half widths of intervals (m, len(steps), d_s).

        Parameters
        ----------
        level : float
        steps : ndarray of int
            From 0, the first step after the start; infinite beyond the last calibrated one.
        std : ndarray of shape (m, len(steps), d_s)
            Standard deviations as the model gives them.
        """
        unit = self.modulation.of(std, steps)
        with np.errstate(invalid="ignore"):
            widths = self.multiples(level, steps) * unit
        # a score of 0 says nothing where the model does not know at all
        return np.where(np.isinf(unit), np.inf, widths)

    def multiples(self, level: float, steps: Ints) -> Floats:
        """Half widths in the unit of the scores (len(steps), d_s)."""
        within = steps < len(self.logged)
        kept = steps[within]
        scores = self.scores if self.scores.ndim == 1 else self.scores[:, kept]
        count = (~np.isnan(scores)).sum(axis=0)
        # the tolerance: 0.55 * 100 is 55.000000000000007 in floating point
        rank = np.ceil((count + 1) * level - 1e-9).astype(np.intp)
        last = np.maximum(np.minimum(rank, count) - 1, 0)
        chosen = np.take_along_axis(scores, last[None], axis=0)[0]
        widths = np.full((len(steps), self.logged.shape[1]), np.inf)
        widths[within] = np.where((rank <= count) & self.logged[kept], chosen, np.inf)
        return widths


def marginal_bands(residuals: Residuals, elapsed: Floats) -> ConformalBands:
    """Bands that hold at each horizon and state by itself.

    Their unit is the standard deviation as the model gives it: one that was rescaled by what
    these episodes say would favour them over new ones.

    Parameters
    ----------
    residuals : Residuals
    elapsed : ndarray of shape (H,)
    """
    scores = residuals.standardised
    logged: NDArray[np.bool_] = np.asarray(~np.isnan(scores).all(axis=0))
    as_given = Rescaling(np.ones(logged.shape), np.zeros(logged.shape))
    return ConformalBands(np.sort(np.abs(scores), axis=0), as_given, logged, elapsed)


def simultaneous_bands(
    residuals: Residuals, modulation: Rescaling, elapsed: Floats
) -> ConformalBands:
    """Bands that hold at all steps and states of an episode together.

    Parameters
    ----------
    residuals : Residuals
    modulation : Rescaling
        Learned from other episodes.
    elapsed : ndarray of shape (H,)
    """
    scores = residuals.rescaled(modulation).standardised
    largest = np.nanmax(np.abs(scores), axis=(1, 2))
    ever = ~np.isnan(scores).all(axis=(0, 1))
    reached = ~np.isnan(scores).all(axis=(0, 2))
    # an episode may end early, but not all of them
    within = np.flip(np.logical_or.accumulate(np.flip(reached)))
    logged = within[:, None] & ever
    return ConformalBands(np.sort(largest), modulation, logged, elapsed)


def steps_of(horizons: NDArray[np.generic], elapsed: Floats) -> Ints:
    """Calibrated step of each horizon, from 0; `len(elapsed)` and more beyond the last.

    Parameters
    ----------
    horizons : ndarray of shape (H,)
        Steps, or times after the start: then the next calibrated step at or after.
    elapsed : ndarray of shape (H,)
        Time from the start to each calibrated step, increasing.
    """
    if np.issubdtype(horizons.dtype, np.integer):
        return horizons.astype(np.intp) - 1
    # a thousandth of a step is no other time
    slack = 1e-3 * elapsed[-1] / len(elapsed)
    return np.searchsorted(elapsed, horizons.astype(np.float64) - slack).astype(np.intp)


def half_widths(
    bands: NDArray[np.object_],
    level: float,
    std: Floats,
    horizons: NDArray[np.generic],
    lengths: Ints,
) -> Floats:
    """Half widths of intervals (n, H, d_s).

    Parameters
    ----------
    bands : ndarray of shape (n,) of ConformalBands
    level : float
    std : ndarray of shape (n, H, d_s)
        Standard deviations as the model gives them.
    horizons : ndarray of shape (H,)
    lengths : ndarray of shape (n,)
        Predicted steps of each forecast, of which a warning speaks.
    """
    widths = np.empty_like(std)
    for one in {id(one): one for one in bands}.values():
        own = np.array([other is one for other in bands])
        steps = steps_of(horizons, one.elapsed)
        widths[own] = one.at(level, steps, std[own])
        # nothing is asked of states that nobody logged
        asked = one.multiples(level, steps)[: lengths[own].max(), one.logged.any(axis=0)]
        infinite = np.isinf(asked)
        if infinite.any():
            _warn_infinite(one, level, infinite.any(axis=1), horizons)
    return widths


def _warn_infinite(
    bands: ConformalBands, level: float, infinite: NDArray[np.bool_], horizons: NDArray[np.generic]
) -> None:
    first = horizons[np.argmax(infinite)]
    least = int(np.ceil(level / (1 - level) - 1e-9))
    half = " (simultaneous bands: twice as many)" if bands.band == "simultaneous" else ""
    warnings.warn(
        f"{infinite.sum()} of {len(infinite)} horizons (first {first}) have infinite intervals: "
        f"at level {level:g} bands need {least} or more calibration episodes that reach the "
        f"horizon and do not diverge{half} ({bands!r}). Calibrate on more or longer episodes, ask "
        'for a lower level, or take method="variance".',
        CalibrationWarning,
        stacklevel=4,
    )
