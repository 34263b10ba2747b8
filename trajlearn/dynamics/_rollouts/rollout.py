"""Rolling a one-step model out: all episodes, particles and members at once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# (states (m, d_s), step, actions before (m, d_a) or None where nobody knows them yet)
# -> rows of inputs (m, n_features), and the actions among them or None
InputRows = Callable[[Floats, int, Floats | None], tuple[Floats, Floats | None]]
# states after a step: (rows (m, n_features), step) -> (m, d_s)
Step = Callable[[Floats, int], Floats]


@dataclass(frozen=True)
class Limits:
    """Where states are clipped, and where a roll-out counts as diverged."""

    clip: tuple[Floats, Floats] | None
    centre: Floats
    reach: Floats

    def apply(self, states: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Clipped states (..., d_s), and which of them have diverged (...)."""
        states = self.clipped(states)
        with np.errstate(invalid="ignore"):
            off = ~(np.abs(states - self.centre) <= self.reach)
        return states, np.any(off, axis=-1)

    def clipped(self, states: Floats) -> Floats:
        """States (..., d_s), clipped if that is asked for."""
        return states if self.clip is None else np.clip(states, *self.clip)


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
        Rows of the learner's inputs, and actions, from states, the number of the step and the
        actions before.
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
    actions = None
    for k in range(n_steps):
        rows, actions = inputs(states, k, actions)
        with np.errstate(over="ignore", invalid="ignore"):
            states, off = limits.apply(step(rows, k))
        gone |= off
        path[:, k] = states
        if gone.any():
            path[gone, k] = np.inf
            states = np.where(gone[:, None], initial_states, states)
    return path


def filled(times: Floats) -> Floats:
    """Replace the padding at the end of a row by its last time."""
    known = np.where(np.isfinite(times), np.arange(times.shape[1]), 0)
    return np.take_along_axis(times, np.maximum.accumulate(known, axis=1), axis=1)


def checked_actions(actions: Any, block: slice, states: Floats) -> Floats:
    """Actions (m, d_a) that a policy returned.

    Raises
    ------
    ValueError
        If they are not one finite action a state, as wide as the block.
    """
    actions = np.asarray(actions, dtype=np.float64)
    want = (len(states), block.stop - block.start)
    if actions.shape != want:
        raise ValueError(
            f"the policy returned actions of shape {actions.shape} for {len(states)} states; "
            f"expected {want}."
        )
    if not np.isfinite(actions).all():
        raise ValueError("the policy returned NaN or infinite actions for finite states.")
    return actions
