"""Uncertainty by Gaussians: one for each member and start, taken from step to step.

A member is a hypothesis that stays true, as with the particles of TSinf: what is forecast is the
mixture of the members' Gaussians.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._rollouts.rollout import Floats, Limits
from trajlearn.dynamics.propagation._algebra import (
    applied,
    finite_in,
    product,
    root_of,
    transposed,
    whitened,
)
from trajlearn.regressors._prediction import mixture

__all__ = ["Rolled", "Transition", "TransitionStep", "roll_gaussians"]

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Transition:
    """z' = mean + gain u + N(0, noise), where u ~ N(0, I) is what z deviates by.

    z is the state, followed by the action before it where that is an input. With z of mean m and
    covariance L L', u is L^-1 (z - m), and the gain A L for a linear system z' = A z.
    """

    mean: Floats
    """(E, n, d)."""
    gain: Floats
    """(E, n, d, d)."""
    noise: Floats
    """(E, n, d, d)."""


# (mean (E, n, d), lower root of the covariance (E, n, d, d), step) -> Transition
TransitionStep = Callable[[Floats, Floats, int], Transition]


@dataclass(frozen=True)
class Rolled:
    """Mixture of all members at every step: arrays (n, H, d_s), samples one axis more."""

    mean: Floats
    std: Floats
    samples: Floats | None


def roll_gaussians(
    initial: Floats,
    n_steps: int,
    n_members: int,
    step: TransitionStep,
    limits: Limits,
    *,
    initial_root: Floats | None = None,
    n_samples: int = 0,
    rng: np.random.Generator | None = None,
) -> Rolled:
    """Apply a step of Gaussians again and again.

    Parameters
    ----------
    initial : ndarray of shape (n, d)
    n_steps : int
        H.
    n_members : int
        E.
    step : callable
    limits : Limits
        Of the first d_s of the d numbers.
    initial_root : ndarray of shape (n, d, d), optional
        Lower root of the covariance of the starts; default: they are known exactly.
    n_samples : int, default=0
        Whole paths to draw through the same steps, each of one member.
    rng : Generator, optional
        Draws the paths.

    Returns
    -------
    Rolled
        The mean is +inf from the step on at which that of a member diverged; standard deviation
        and samples also from where a member's covariance did.
    """
    d_s = len(limits.centre)
    shape = n_members, *initial.shape
    mean, root = np.broadcast_to(initial, shape), np.zeros((*shape, shape[-1]))
    if initial_root is not None:
        root = root + initial_root
    lost, wild = np.zeros((2, *shape[:2]), dtype=bool)
    means, variances = np.empty((2, *shape[:2], n_steps, d_s))
    paths = None
    if n_samples and rng is not None:
        paths = _Paths(initial, initial_root, n_samples, n_members, n_steps, limits, rng)
    for k in range(n_steps):
        with np.errstate(over="ignore", invalid="ignore"):
            after = step(mean, root, k)
            covariance = product(after.gain, transposed(after.gain)) + after.noise
            states, off = limits.apply(after.mean[..., :d_s])
            lost = lost | off
            wild = wild | lost | _blown(covariance, limits)
            next_mean = np.concatenate([states, after.mean[..., d_s:]], axis=-1)
            next_mean = np.where(lost[..., None], initial, next_mean)
            next_root = root_of(np.where(wild[..., None, None], 0.0, covariance))
            if paths is not None:
                paths.draw(k, (mean, root), after, next_mean, wild)
        means[:, :, k] = np.where(lost[..., None], np.inf, states)
        spread = np.diagonal(covariance, axis1=-2, axis2=-1)[..., :d_s]
        variances[:, :, k] = np.where(wild[..., None], np.inf, spread)
        mean, root = next_mean, next_root
    with np.errstate(invalid="ignore"):
        centre, variance = mixture(means, variances)
        std = np.sqrt(variance)
    diverged = np.isinf(variances).any(axis=0)
    std = np.where(diverged, np.inf, std)
    return Rolled(centre, std, None if paths is None else paths.states)


def _blown(covariance: Floats, limits: Limits) -> Bools:
    """Which covariances (..., d, d) are not finite or beyond the limits."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)[..., : len(limits.reach)]
    return ~finite_in(covariance) | np.any(variance > limits.reach**2, axis=-1)


class _Paths:
    """Whole trajectories through the steps of the Gaussians: joint draws over time."""

    def __init__(
        self,
        initial: Floats,
        initial_root: Floats | None,
        n_samples: int,
        n_members: int,
        n_steps: int,
        limits: Limits,
        rng: np.random.Generator,
    ) -> None:
        self._rng, self._limits = rng, limits
        self._member = rng.permutation(np.arange(n_samples) % n_members)
        self._now = np.tile(initial, (n_samples, 1, 1))
        if initial_root is not None:
            self._now += applied(initial_root, rng.standard_normal(self._now.shape))
        self._gone = np.zeros((n_samples, len(initial)), dtype=bool)
        self.states = np.empty((n_samples, len(initial), n_steps, len(limits.centre)))

    def draw(
        self,
        k: int,
        before: tuple[Floats, Floats],
        after: Transition,
        next_mean: Floats,
        wild: Bools,
    ) -> None:
        """Take all paths one step on."""
        d_s = self.states.shape[-1]
        noise, noise_root = self._rng.standard_normal(self._now.shape), root_of(after.noise)
        for e, (mean, root) in enumerate(zip(*before)):
            own = self._member == e
            deviation = whitened(root, self._now[own] - mean)
            now = after.mean[e] + applied(after.gain[e], deviation)
            now += applied(noise_root[e], noise[own])
            states, off = self._limits.apply(now[..., :d_s])
            gone = self._gone[own] | off | wild[e]
            now[..., :d_s] = states
            self.states[own, :, k] = np.where(gone[..., None], np.inf, states)
            self._now[own] = np.where(gone[..., None], next_mean[e], now)
            self._gone[own] = gone
