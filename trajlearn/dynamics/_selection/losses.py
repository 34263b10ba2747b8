"""Robust losses of several forecasters on the same held-out episodes, smooth over horizons."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from trajlearn.dynamics._forecaster import DIVERGENCE_RANGES

__all__ = ["HorizonLosses", "horizon_losses", "knots_of"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# horizons are judged this densely: every step at first, then at this ratio
_KNOTS = 1.03
# squared errors, in training ranges, below which all forecasts are as good as exact
_EXACT = 1e-24


def knots_of(n_steps: int) -> Ints:
    """Steps 1 ... n_steps, thinned out where neighbours differ by less than 3 %."""
    knots = [1]
    while knots[-1] < n_steps:
        knots.append(min(max(knots[-1] + 1, int(knots[-1] * _KNOTS)), n_steps))
    return np.array(knots, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class HorizonLosses:
    """Losses of M members on n held-out episodes at K horizons.

    Attributes
    ----------
    knots : ndarray of shape (K,)
        Steps.
    values : ndarray of shape (M, n, K)
        NaN where an episode does not reach the step.
    units : ndarray of shape (n,)
        What is independent of one another: the episode, or its group, counted from 0.
    eligible : ndarray of shape (M, K)
        Whether a member forecasts as many episodes as any other does.
    width : ndarray of shape (K,)
        Steps that each knot stands for.
    typical : ndarray of shape (n, K)
        Squared error that counts as one, see `horizon_losses`.
    """

    knots: Ints
    values: Floats
    units: Ints
    eligible: NDArray[np.bool_]
    width: Floats
    typical: Floats

    @property
    def averages(self) -> Floats:
        """Mean over the episodes that a member forecasts to a horizon (M, K); NaN of none."""
        known = ~np.isnan(self.values)
        total, count = np.where(known, self.values, 0.0).sum(axis=1), known.sum(axis=1)
        return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)

    @property
    def means(self) -> Floats:
        """Mean over episodes (M, K); inf where a member is not eligible."""
        return np.where(self.eligible, self.averages, np.inf)

    def ranking(self, knots: slice = slice(None)) -> list[int]:
        """Members by their mean loss over a block of horizons, the best first.

        Who does not forecast as many episodes at some step as others do is behind all who do.
        """
        width = self.width[knots]
        lacking = (~self.eligible[:, knots] * width).sum(axis=1)
        reached = np.nan_to_num(self.averages[:, knots])
        return [int(i) for i in np.lexsort(((reached * width).sum(axis=1), lacking))]

    def gain(self, one: Ints, other: Ints) -> tuple[Floats, Floats]:
        """How much less a member loses than another, paired by episode, and how surely.

        Parameters
        ----------
        one, other : ndarray of shape (K,)
            Members at each knot.

        Returns
        -------
        gain : ndarray of shape (K,)
            Mean over episodes of the difference of the losses; positive if `one` is better.
        error : ndarray of shape (K,)
            Its standard error, that of groups where there are; inf if one unit reaches the knot.
            With few units it is greater by the ratio of Student's quantile to the Gaussian one,
            so that a gain of one standard error is equally sure with few and with many.
        """
        at = np.arange(len(self.knots))
        return paired(self.values[other, :, at].T - self.values[one, :, at].T, self.units)

    def over(self, knots: slice, one: int, other: int) -> tuple[float, float]:
        """The same over a block of horizons: of the mean over its steps."""
        difference = self.values[other, :, knots] - self.values[one, :, knots]
        known = ~np.isnan(difference)
        weight = np.where(known, self.width[knots], 0.0)
        total = weight.sum(axis=1)
        summed = (weight * np.where(known, difference, 0.0)).sum(axis=1)
        mean = np.divide(summed, total, out=np.full(len(total), np.nan), where=total > 0)
        gain, error = paired(mean[:, None], self.units)
        return float(gain[0]), float(error[0])


def paired(differences: Floats, units: Ints) -> tuple[Floats, Floats]:
    """Mean over episodes (n, K) and its standard error, clustered by unit; NaN is absent."""
    known = ~np.isnan(differences)
    count = known.sum(axis=0)
    mean = np.where(known, differences, 0.0).sum(axis=0) / np.maximum(count, 1)
    off = np.where(known, differences - mean, 0.0)
    n_units = int(units.max()) + 1
    by_unit = np.zeros((n_units, differences.shape[1]))
    np.add.at(by_unit, units, off)
    reached = np.zeros((n_units, differences.shape[1]))
    np.add.at(reached, units, known)
    freedom = (reached > 0).sum(axis=0) - 1
    enough = np.maximum(freedom, 1)
    # what one standard deviation of a Gaussian is sure of
    wider = t.ppf(norm.cdf(1.0), enough)
    spread = np.sqrt((enough + 1) / enough * (by_unit**2).sum(axis=0))
    return mean, np.where(freedom > 0, wider * spread / np.maximum(count, 1), np.inf)


def horizon_losses(errors: Floats, units: Ints, bandwidth: float) -> HorizonLosses:
    """Losses log(1 + e / m) of squared errors e.

    Far-off forecasts count by their logarithm, so that one episode in which all go wrong decides
    nothing. The unit m is the geometric mean of two: the median error of the best member, below
    which an error matters little, and the error of the best member on the episode itself, so that
    easy episodes still tell members apart where most are hard (few episodes, the range of which
    others leave). Squared errors are averaged over neighbouring horizons first: the measurement
    noise of the held-out states averages out.

    Parameters
    ----------
    errors : ndarray of shape (M, n, H)
        NaN where there is nothing to compare; inf where a forecast has diverged, which counts as
        the squared distance at which it is said to have.
    units : ndarray of shape (n,)
    bandwidth : float
        Half the width of what counts as neighbouring, in log(horizon).
    """
    n_steps = errors.shape[2]
    knots = knots_of(n_steps)
    known = ~np.isnan(errors)
    smooth = averaged(np.minimum(errors, DIVERGENCE_RANGES**2), known, knots, bandwidth)
    reached = known[..., knots - 1]
    count = reached.sum(axis=1)
    edges = np.concatenate([[0.5], np.sqrt(knots[1:] * knots[:-1]), [n_steps + 0.5]])
    eligible = (count == count.max(axis=0)) & (count > 0)
    # a knot is chosen for all the steps it stands for
    begins = np.ceil(edges[:-1]).astype(np.intp) - 1
    of_step = known.sum(axis=1)
    whole = eligible & np.logical_and.reduceat(of_step == of_step.max(axis=0), begins, axis=1)
    eligible = np.where(whole.any(axis=0), whole, eligible)
    # who has left the race was judged by fewer episodes, and is fitted on a part of them
    judged = known.any(axis=2).sum(axis=1)
    eligible &= (judged == judged.max())[:, None]
    smooth = np.maximum(smooth, _EXACT)
    medians = np.where(eligible, _medians(np.where(reached, smooth, np.nan)), np.inf)
    least = np.where(eligible[:, None] & reached, smooth, np.inf).min(axis=0)
    # an episode that does not reach a step has no unit there
    least = np.where(np.isfinite(least), least, 1.0)
    typical = np.sqrt(least * medians.min(axis=0))
    values = np.where(reached, np.log1p(smooth / typical), np.nan)
    return HorizonLosses(knots, values, units, eligible, np.diff(edges), typical)


def averaged(values: Floats, known: NDArray[np.bool_], knots: Ints, bandwidth: float) -> Floats:
    """Averages of values (..., H) about each knot (..., K), over what is known."""
    kernel = kernel_of(values.shape[-1], knots, bandwidth)
    total = np.where(known, values, 0.0) @ kernel.T
    return total / np.maximum(known @ kernel.T, 1e-300)


def kernel_of(n_steps: int, knots: Ints, bandwidth: float) -> Floats:
    """Weights (K, H) of the steps about each knot: Epanechnikov's, in log(horizon).

    They end at the bandwidth: far-off errors must not be felt where all is still well.
    """
    gap = np.log(knots)[:, None] - np.log(np.arange(1, n_steps + 1))
    return np.maximum(1 - (gap / max(bandwidth, 1e-9)) ** 2, 0.0)


def _medians(values: Floats) -> Floats:
    """Median over axis 1 without NaN; NaN where there is nothing."""
    found = np.full((values.shape[0], values.shape[2]), np.nan)
    some = ~np.isnan(values).all(axis=1)
    for m, k in zip(*np.nonzero(some)):
        column = values[m, :, k]
        found[m, k] = np.median(column[~np.isnan(column)])
    return found
