"""How a Gaussian is taken through a learned step: by slopes at its mean, or by sigma points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trajlearn.dynamics._learner import FullMoments
from trajlearn.dynamics._rollouts.rollout import Floats, InputRows, Limits
from trajlearn.dynamics.propagation._algebra import product, transposed
from trajlearn.dynamics.propagation._gaussians import Transition, TransitionStep

__all__ = ["Image", "around", "linearised", "mean_only", "sigma_weights", "slopes", "unscented"]

# Half the distance of finite differences, in training ranges: networks compute in single
# precision, so that a smaller one would measure round-off.
DIFFERENCE = 1e-3

# points (E, P, n, d) and the step -> their means (E, P, n, d) and variances (E, P, n, d)
PointMap = Callable[[Floats, int], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Image:
    """The learned step as a map of points: policy, input rows and members, each its own points.

    A point is a state, followed by the action before it where that is an input.
    """

    inputs: InputRows
    moments: FullMoments
    limits: Limits
    carries: bool
    """Whether the action before is an input."""

    def rows(self, points: Floats, k: int) -> tuple[Floats, Floats | None]:
        """Input rows (E, P * n, n_features) and, where they are carried, actions (E, P, n, d_a)."""
        d_s, flat = len(self.limits.centre), points.reshape(-1, points.shape[-1])
        # at the first step it is known from the log, if there was one
        previous = flat[:, d_s:] if self.carries and k else None
        rows, actions = self.inputs(flat[:, :d_s], k, previous)
        rows = rows.reshape(len(points), -1, rows.shape[1])
        if not self.carries or actions is None:
            return rows, None
        return rows, actions.reshape(*points.shape[:-1], -1)

    def __call__(self, points: Floats, k: int) -> tuple[Floats, Floats]:
        """Means and variances (E, P, n, d) of what follows points (E, P, n, d)."""
        rows, actions = self.rows(points, k)
        means, variances = self.moments(rows)
        shape = (*points.shape[:-1], means.shape[-1])
        means = self.limits.clipped(means.reshape(shape))
        variances = variances.reshape(shape)
        if actions is None:
            return means, variances
        still = np.zeros(actions.shape)
        return np.concatenate([means, actions], -1), np.concatenate([variances, still], -1)


def around(mean: Floats, offsets: Floats) -> Floats:
    """Points (E, 1 + 2 q, n, d): the mean (E, n, d), then plus, then minus offsets (E, q, n, d)."""
    centre = mean[:, None]
    return np.concatenate([centre, centre + offsets, centre - offsets], axis=1)


def slopes(values: Floats, points: Floats) -> Floats:
    """Jacobians (E, n, k, d) from values (E, 1 + 2 d, n, k) at points `around` along the axes."""
    d = points.shape[-1]
    axis = np.arange(d)
    apart = points[:, 1 + axis, :, axis] - points[:, 1 + d + axis, :, axis]  # (d, E, n)
    change = values[:, 1 : 1 + d] - values[:, 1 + d :]
    return np.moveaxis(change / np.moveaxis(apart, 0, 1)[..., None], 1, -1)


def mean_only(image: PointMap) -> TransitionStep:
    """The mean of each member alone: that of `linearised`, which does not depend on the spread."""

    def step(mean: Floats, root: Floats, k: int) -> Transition:
        means, _ = image(mean[:, None], k)
        return Transition(means[:, 0], np.zeros_like(root), np.zeros_like(root))

    return step


def linearised(image: PointMap, width: Floats) -> TransitionStep:
    """By the slopes and the variance at the mean.

    Parameters
    ----------
    image : callable
    width : ndarray of shape (d,)
        Training ranges, the unit of the finite differences.
    """
    offsets = (DIFFERENCE * np.diag(width))[None, :, None, :]

    def step(mean: Floats, root: Floats, k: int) -> Transition:
        points = around(mean, offsets)
        means, variances = image(points, k)
        gain = product(slopes(means, points), root)
        return Transition(means[:, 0], gain, _diagonal(variances[:, 0]))

    return step


def sigma_weights(d: int) -> tuple[Floats, Floats]:
    """Weights (1 + 2 d,) of the sigma points for the mean and for the covariance.

    kappa = 3 - d fits the fourth moments of a Gaussian; beyond three dimensions it would give the
    centre a negative weight, with which covariances, and averaged variances, may be negative.
    """
    from filterpy.kalman import MerweScaledSigmaPoints

    chosen = MerweScaledSigmaPoints(d, alpha=1.0, beta=0.0, kappa=max(3.0 - d, 0.0))
    return chosen.Wm, chosen.Wc


def unscented(image: PointMap, d: int) -> TransitionStep:
    """By sigma points: exact for the mean of a quadratic map.

    Parameters
    ----------
    image : callable
    d : int
        Numbers in a point.
    """
    for_mean, for_covariance = sigma_weights(d)
    reach = np.sqrt(0.5 / for_mean[1])

    def step(mean: Floats, root: Floats, k: int) -> Transition:
        points = around(mean, reach * np.moveaxis(root, -1, 1))
        means, variances = image(points, k)
        centre = means[:, 0]
        shift, variance = np.zeros_like(centre), for_mean[0] * variances[:, 0]
        for i in range(1, 1 + 2 * d):
            shift += for_mean[i] * (means[:, i] - centre)
            variance += for_mean[i] * variances[:, i]
        plus, minus = means[:, 1 : 1 + d], means[:, 1 + d :]
        gain = np.moveaxis((plus - minus) / (2 * reach), 1, -1)
        # what is left of the covariance when the linear part is taken out: the bend of the map
        bends = np.sqrt(for_covariance[1] / 2) * (plus + minus - 2 * (centre + shift)[:, None])
        bends = np.concatenate([np.sqrt(for_covariance[0]) * shift[:, None], bends], axis=1)
        bends = np.moveaxis(bends, 1, -1)
        noise = product(bends, transposed(bends)) + _diagonal(variance)
        return Transition(centre + shift, gain, noise)

    return step


def _diagonal(variances: Floats) -> Floats:
    return variances[..., None] * np.eye(variances.shape[-1])
