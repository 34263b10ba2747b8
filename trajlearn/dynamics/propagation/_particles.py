"""Uncertainty by particles: steps of many roll-outs that each draw their own next state."""

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._learner import ByMember, FullMoments, Moments
from trajlearn.dynamics._rollouts.rollout import Floats, Step
from trajlearn.regressors._prediction import mean_of_members, mixture

__all__ = ["drawn_step", "expected_step", "member_step"]


def expected_step(moments: Moments) -> Step:
    """Mean over members at every step."""
    return lambda rows, k: mean_of_members(moments(rows)[0])


def drawn_step(moments: FullMoments, rng: np.random.Generator) -> Step:
    """One Gaussian with the mean and the variance of all members, drawn from at every step."""

    def step(rows: Floats, k: int) -> Floats:
        mean, variance = mixture(*moments(rows))
        return mean + np.sqrt(variance) * rng.standard_normal(mean.shape)

    return step


def member_step(
    moments: ByMember, member: NDArray[np.intp] | int, rng: np.random.Generator
) -> Step:
    """One member a particle, with its noise: fixed (TSinf), or drawn anew at every step (TS1).

    Parameters
    ----------
    moments : callable
    member : ndarray of shape (m,) or int
        Member of each particle, or E: one of so many is drawn at every step.
    rng : Generator
    """

    def step(rows: Floats, k: int) -> Floats:
        which = rng.integers(member, size=len(rows)) if isinstance(member, int) else member
        means, variances = moments(rows, which)
        return means + np.sqrt(variances) * rng.standard_normal(means.shape)

    return step
