"""Rolling a one-step model out: all episodes, particles and members at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._learner import Moments
from trajlearn.regressors._prediction import mean_of_members

Floats = NDArray[np.float64]
# rows of inputs for the states at a step: (states (m, d_s), step) -> (m, n_features)
InputRows = Callable[[Floats, int], Floats]
# states after a step: (rows (m, n_features), step) -> (m, d_s)
Step = Callable[[Floats, int], Floats]


@dataclass(frozen=True)
class Limits:
    """Where states are clipped, and where a roll-out counts as diverged."""

    clip: tuple[Floats, Floats] | None
    centre: Floats
    reach: Floats

    def apply(self, states: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Clipped states, and which rows have diverged."""
        if self.clip is not None:
            states = np.clip(states, *self.clip)
        with np.errstate(invalid="ignore"):
            off = ~(np.abs(states - self.centre) <= self.reach)
        return states, np.any(off, axis=1)


def roll_out(
    initial_states: Floats,
    n_steps: int,
    inputs: InputRows,
    step: Step,
    limits: Limits,
) -> Floats:
    """Apply a step function again and again.

    Parameters
    ----------
    initial_states : ndarray of shape (m, d_s)
    n_steps : int
    inputs : callable
        Rows of the learner's inputs from states and the number of the step.
    step : callable
        ``step(rows, k) -> states`` after step k.
    limits : Limits

    Returns
    -------
    ndarray of shape (m, n_steps, d_s)
        +inf from the step on at which a row diverged; its place is taken by the initial state
        meanwhile, so that learners and policies never see a non-finite number.
    """
    states = initial_states
    path = np.empty((len(states), n_steps, states.shape[1]))
    gone = np.zeros(len(states), dtype=bool)
    for k in range(n_steps):
        with np.errstate(over="ignore", invalid="ignore"):
            states, off = limits.apply(step(inputs(states, k), k))
        gone |= off
        path[:, k] = states
        if gone.any():
            path[gone, k] = np.inf
            states = np.where(gone[:, None], initial_states, states)
    return path


def expected_step(moments: Moments) -> Step:
    """Mean over members at every step."""
    return lambda rows, k: mean_of_members(moments(rows)[0])


def sampled_step(
    moments: Callable[[Floats], tuple[Floats, Floats]],
    member: NDArray[np.intp] | None,
    rng: np.random.Generator,
) -> Step:
    """One member a particle, with its noise: fixed (TSinf), or drawn anew at every step (TS1).

    Parameters
    ----------
    moments : callable
    member : ndarray of shape (m,) or None
        Member of each particle; None draws one at every step.
    rng : Generator
    """

    def step(rows: Floats, k: int) -> Floats:
        means, variances = moments(rows)
        which = rng.integers(len(means), size=len(rows)) if member is None else member
        particle = np.arange(len(rows))
        noise = rng.standard_normal(means.shape[1:])
        return means[which, particle] + np.sqrt(variances[which, particle]) * noise

    return step
