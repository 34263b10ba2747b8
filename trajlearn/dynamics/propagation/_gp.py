"""Exact moments of one step of a Gaussian process: PILCO's propagation."""

from collections.abc import Callable
from typing import Any

import numpy as np

from trajlearn.dynamics._rollouts.rollout import Floats
from trajlearn.dynamics.propagation._algebra import (
    finite_in,
    nearest_semidefinite,
    product,
    transposed,
)
from trajlearn.dynamics.propagation._gaussians import Transition, TransitionStep
from trajlearn.dynamics.propagation._steps import DIFFERENCE, Image, around, slopes
from trajlearn.regressors._gp_moments import GaussianMoments, noise_variance
from trajlearn.regressors.gp import GPRegressor

__all__ = ["gp_moments", "has_exact_moments"]

# directions of the inputs that vary less than this share of the widest are taken for known
_LEAST = 1e-7


def has_exact_moments(learner: Any) -> bool:
    """Whether the moments of a learner at a Gaussian input are known in closed form."""
    return isinstance(learner, GPRegressor) and learner.kernel == "rbf"


def gp_moments(
    gp: GPRegressor,
    image: Image,
    scaled: Callable[[Floats], Floats],
    width: Floats,
    *,
    target_scale: Floats,
    change: bool,
) -> TransitionStep:
    """Step of the one member that a GP is.

    Parameters
    ----------
    gp : GPRegressor
    image : Image
        Gives the input rows at points.
    scaled : callable
        From rows to what the GP takes.
    width : ndarray of shape (d,)
        Training ranges, the unit of the finite differences by which policy and scaling enter.
    target_scale : ndarray of shape (d_s,)
        What the GP's outputs are in units of.
    change : bool
        Whether they are changes of the state.
    """
    moments = GaussianMoments(gp)
    noise = np.diag(noise_variance(gp) * target_scale**2)
    offsets = (DIFFERENCE * np.diag(width))[None, :, None, :]
    d_s = len(target_scale)

    def step(mean: Floats, root: Floats, k: int) -> Transition:
        points = around(mean, offsets)
        rows, actions = image.rows(points, k)
        inputs = scaled(rows[0]).reshape(*points.shape[:3], -1)
        spread = product(slopes(inputs, points), root)[0]
        centre, covariance, gain = _learned(moments, inputs[0, 0], spread)
        centre, gain = centre * target_scale, gain * target_scale[:, None]
        covariance = covariance * np.outer(target_scale, target_scale)
        rest = nearest_semidefinite(covariance - product(gain, transposed(gain))) + noise
        if change:
            centre, gain = centre + mean[0, :, :d_s], gain + root[0, :, :d_s]
        if actions is None:
            return Transition(centre[None], gain[None], rest[None])
        by_actions = product(slopes(actions, points), root)
        d = mean.shape[-1]
        padded = np.zeros((*centre.shape[:1], d, d))
        padded[:, :d_s, :d_s] = rest
        return Transition(
            np.concatenate([centre[None], actions[:, 0]], axis=-1),
            np.concatenate([gain[None], by_actions], axis=-2),
            padded[None],
        )

    return step


def _learned(
    moments: GaussianMoments, mean: Floats, spread: Floats
) -> tuple[Floats, Floats, Floats]:
    """Mean (n, d_s), covariance and gain of the outputs at inputs N(mean, spread spread').

    Infinite where the inputs are not finite.
    """
    covariance = product(spread, transposed(spread))
    finite = finite_in(mean[:, None]) & finite_in(covariance)
    mean = np.where(finite[:, None], mean, 0.0)
    spread = np.where(finite[:, None, None], spread, 0.0)
    covariance = np.where(finite[:, None, None], covariance, 0.0)
    centre, between, cross = moments(mean, covariance)
    # cov(u, f) of an input mean + spread u, where cov(x, f) is spread cov(u, f)
    inverse = np.asarray(np.linalg.pinv(spread, rcond=_LEAST), dtype=np.float64)
    gain = transposed(product(inverse, cross))
    centre = np.where(finite[:, None], centre, np.inf)
    return centre, np.where(finite[:, None, None], between, np.inf), gain
