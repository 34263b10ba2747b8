"""Which member, or which weights, at each horizon."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._selection.convex_weights import cauchy_weights
from trajlearn.dynamics._selection.losses import HorizonLosses, kernel_of, paired

__all__ = ["Choice", "blend", "pick", "step_weights"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Choice:
    """Weights of M members at K horizons.

    Attributes
    ----------
    best : int
        The member of least loss over all horizons.
    weights : ndarray of shape (K, M)
        Each row sums to 1.
    """

    best: int
    weights: Floats


def pick(losses: HorizonLosses, margin: float) -> Choice:
    """The member that is best overall; where another one is surely better, that one.

    Parameters
    ----------
    losses : HorizonLosses
    margin : float
        Standard errors, paired by episode, by which it has to be better.
    """
    best = losses.ranking()[0]
    means = losses.means
    rival = means.argmin(axis=0)
    gain, error = losses.gain(rival, np.full_like(rival, best))
    better = _surely(gain, error, margin) | ~losses.eligible[best]
    chosen = np.where(better, rival, best)
    return Choice(best, np.eye(len(means))[chosen])


def _surely(gain: Floats, error: Floats, margin: float) -> NDArray[np.bool_]:
    """Where a gain is beyond a margin of standard errors; one unit alone has an infinite one."""
    known = np.isfinite(error)
    return known & (gain > margin * np.where(known, error, 0.0))


def blend(
    losses: HorizonLosses, residuals: Floats, margin: float, n_blended: int, bandwidth: float
) -> Choice:
    """The pick; where convex weights of the few members of least loss are surely better, these.

    Parameters
    ----------
    losses : HorizonLosses
    residuals : ndarray of shape (M, n, H, k)
        In training ranges, finite; NaN where there is nothing to compare.
    margin : float
        As of the pick. Weights were fitted to the episodes that judge them, a pick hardly: they
        have to be better by twice as many standard errors.
    n_blended : int
    bandwidth : float
        As of `losses`.
    """
    picked = pick(losses, margin)
    covering = np.flatnonzero(losses.eligible.all(axis=1))
    total = losses.means[covering] @ losses.width
    few = np.sort(covering[np.argsort(total, kind="stable")[:n_blended]])
    if len(few) < 2:
        return picked
    kernel = kernel_of(residuals.shape[2], losses.knots, bandwidth)
    found, errors = cauchy_weights(residuals[few], losses.typical, kernel)
    at = np.arange(len(losses.knots))
    alone = losses.values[picked.weights.argmax(axis=1), :, at].T
    gain, error = paired(alone - np.log1p(errors / losses.typical), losses.units)
    weights = picked.weights.copy()
    better = _surely(gain, error, 2 * margin)
    weights[better] = 0.0
    weights[np.ix_(better, few)] = found[better]
    return Choice(picked.best, weights)


def step_weights(choice: Choice, losses: HorizonLosses, n_steps: int) -> Floats:
    """Weights at each step (n_steps, M): those of the nearest knot."""
    edges = np.cumsum(losses.width)[:-1] + 0.5
    nearest = np.searchsorted(edges, np.arange(1, n_steps + 1), side="right")
    weights: Floats = choice.weights[nearest]
    return weights
