"""What calibration learns from: the residuals of held-out episodes, and how they scale."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

__all__ = ["Rescaling", "Residuals", "crps_rescaling"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# a curve over horizons is not trusted where fewer episodes reach (if there are more at all)
_ENOUGH = 5
# horizons within this ratio of one another share a factor, and the factor is found this densely
_WINDOW, _KNOTS = 1.1, 1.05
# floors that are tried, in typical standard deviations; each has to save this share of the CRPS
_FLOORS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
_WORTH = 2e-3
# share of the largest standard deviation below which one does not say what is typical
_TELLING = 1e-6
# of a model that makes no error at all
_LEAST_FACTOR = 1e-12


@dataclass(frozen=True, eq=False)
class Rescaling:
    """Standard deviations sqrt((factor std)^2 + floor^2), by step and state.

    Attributes
    ----------
    factor, floor : ndarray of shape (H, d_s)
    """

    factor: Floats
    floor: Floats

    def of(self, std: Floats, steps: Ints) -> Floats:
        """Rescaled `std` (..., len(steps), d_s); beyond the last step as at the last."""
        at = np.minimum(steps, len(self.factor) - 1)
        # an infinite std stays infinite: nothing is known there
        with np.errstate(over="ignore"):
            rescaled: Floats = np.hypot(self.factor[at] * std, self.floor[at])
        return rescaled


@dataclass(frozen=True)
class Residuals:
    """Residuals of n episodes, one forecast each.

    Attributes
    ----------
    errors : ndarray of shape (n, H, d_s)
        Logged minus predicted; NaN where nothing was logged, inf where the forecast diverged.
    std : ndarray of shape (n, H, d_s)
        Predicted standard deviations, positive.
    elapsed : ndarray of shape (n, H)
        Time from the start to each step; NaN beyond an episode.
    """

    errors: Floats
    std: Floats
    elapsed: Floats

    def __len__(self) -> int:
        return len(self.errors)

    def __getitem__(self, index: Ints) -> "Residuals":
        return Residuals(self.errors[index], self.std[index], self.elapsed[index])

    @property
    def standardised(self) -> Floats:
        """Errors in predicted standard deviations; inf where the forecast diverged."""
        with np.errstate(invalid="ignore"):
            return np.where(np.isinf(self.errors), np.inf, self.errors / self.std)

    def rescaled(self, rescaling: Rescaling) -> "Residuals":
        """The same residuals of forecasts with rescaled standard deviations."""
        return replace(self, std=rescaling.of(self.std, np.arange(self.std.shape[1])))

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Logged, and not diverged (n, H, d_s)."""
        return np.isfinite(self.errors) & np.isfinite(self.std)

    @property
    def reach(self) -> int:
        """Last step that enough episodes reach without divergence; 0 if none does."""
        count = self.usable.any(axis=2).sum(axis=0)
        return int(np.flatnonzero(count >= min(_ENOUGH, max(count.max(), 1))).max(initial=-1)) + 1


def crps_rescaling(residuals: Residuals) -> Rescaling:
    """Rescaling of the standard deviations that minimises the mean Gaussian CRPS [1].

    The floor is what a model does not know of, such as the measurement noise at both ends of a
    short horizon; without it, a factor would have to serve rows that are much too sure and rows
    that are not. Both are those of the horizons within 10 %. A far-off error counts as a miss, not
    by its square, so that heavy tails do not widen everything.

    Diverged cells say nothing and are left out. Beyond the last step that enough episodes reach
    the rescaling stays; a state that was never logged is left as it is.

    References
    ----------
    [1] Gneiting, Raftery, Westveld and Goldman, "Calibrated probabilistic forecasting using
        ensemble model output statistics and minimum CRPS estimation", Monthly Weather Review 133
        (2005): there, too, the variance is an affine function of that of the ensemble.
    """
    _, n_steps, d_s = residuals.errors.shape
    factors, floors, reach = np.ones((n_steps, d_s)), np.zeros((n_steps, d_s)), residuals.reach
    if not reach:
        return Rescaling(factors, floors)
    usable = residuals.usable[:, :reach]
    errors = np.where(usable, residuals.errors[:, :reach], 0.0)
    std = np.where(usable, residuals.std[:, :reach], 0.0)
    knots = _knots(reach)
    found = np.stack(
        [
            _best(errors[:, first:last].reshape(-1, d_s), std[:, first:last].reshape(-1, d_s))
            for first, last in (_window(knot, reach) for knot in knots)
        ]
    )
    steps = np.log(np.arange(1, n_steps + 1))
    for j in range(d_s):
        known = np.isfinite(found[:, 0, j])
        if known.any():
            at = np.log(knots[known])
            factors[:, j] = np.interp(steps, at, found[known, 0, j])
            floors[:, j] = np.interp(steps, at, found[known, 1, j])
    return Rescaling(factors, floors)


def _knots(reach: int) -> Ints:
    """Steps 1 ... reach, thinned out where neighbours share most of their window."""
    knots = [1]
    while knots[-1] < reach:
        knots.append(min(max(knots[-1] + 1, int(knots[-1] * _KNOTS)), reach))
    return np.array(knots, dtype=np.intp)


def _window(knot: int, reach: int) -> tuple[int, int]:
    """First and one past the last index of the steps that share a factor with a knot."""
    return int(np.ceil(knot / _WINDOW)) - 1, min(int(knot * _WINDOW), reach)


def _best(errors: Floats, std: Floats) -> Floats:
    """Factor and floor (2, d) of least CRPS, from residuals (m, d) where `std` is not 0."""
    count = np.maximum((std > 0).sum(axis=0), 1)
    # rows of (nearly) no std are those that need a floor, and do not tell how high it should be
    told = std > _TELLING * std.max(axis=0, initial=0.0)
    logs = np.log(std, out=np.zeros_like(std), where=told)
    typical = np.exp(logs.sum(axis=0) / np.maximum(told.sum(axis=0), 1))
    best = np.full((2, std.shape[1]), np.nan)
    least = np.full(std.shape[1], np.inf)
    for ratio in _FLOORS:
        wider = np.where(std > 0, np.hypot(std, ratio * typical), 0.0)
        factor = _root(errors, wider)
        score = _mean_crps(errors, factor * wider, count)
        # a floor has to be worth it
        better = score < (1 - _WORTH) * least
        least = np.where(better, score, least)
        best = np.where(better, [factor, factor * ratio * typical], best)
    return best


def _mean_crps(errors: Floats, std: Floats, count: Ints) -> Floats:
    """Mean Gaussian CRPS of each column, where `std` is not 0."""
    known = std > 0
    z = np.divide(errors, std, out=np.zeros_like(errors), where=known)
    density = np.exp(-0.5 * np.minimum(z**2, 1400.0)) / np.sqrt(2 * np.pi)
    score = z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)
    return (std * score).sum(axis=0) / count


def _root(errors: Floats, std: Floats) -> Floats:
    """Factor c of least CRPS of each column, from residuals (m, d) where `std` is not 0.

    For N(mu, (c sigma)^2) and a residual e the derivative of the CRPS in c vanishes where the
    mean of ``sigma (exp(-e^2 / (2 c^2 sigma^2)) - 2^{-1/2})`` does, which has one root. With
    u = 1 / (2 c^2) the logarithm of the weighted mean of exp(-u e^2 / sigma^2) is convex and
    falls from 0: Newton's method from the left runs to the root without overshooting.
    """
    total = std.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.divide(errors, std, out=np.zeros_like(errors), where=std > 0) ** 2
        weight = std / total
        u = np.log(2) / 2 / (weight * ratio).sum(axis=0)
        for _ in range(100):
            kept = weight * np.exp(-np.minimum(u * ratio, 700.0))
            slope = (kept * ratio).sum(axis=0)
            share = kept.sum(axis=0)
            step = (np.log(share) + np.log(2) / 2) * share / slope
            # no slope is left where nearly all errors are zero
            u = np.where(slope > 0, u + step, np.inf)
            if not (step > 1e-10 * u).any():
                break
        # with so many errors of 0 no factor is best, and certainty the worst answer
        exact = (weight * (ratio == 0)).sum(axis=0) >= np.sqrt(0.5)
        found = np.where(exact, np.abs(errors).sum(axis=0) / total, np.sqrt(1 / (2 * u)))
        factor = np.maximum(found, _LEAST_FACTOR)
    return np.where(total > 0, factor, np.nan)
