"""Blocks of a row that say what came before: past states and past actions.

Past states are written as differences of one state and the next, s_t - s_{t-1} first: states
themselves would be almost equal, so that after scaling a learner would look for the motion in
their last digits.
"""

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["action_names", "differences", "past_actions", "past_states", "state_names"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def differences(window: Floats) -> Floats:
    """Rows (m, (k - 1) * d_s) from the last k states (m, k, d_s), newest first."""
    return (window[:, :-1] - window[:, 1:]).reshape(len(window), -1)


def past_states(ds: TrajectoryDataset, episode: Ints, state: Ints, history: int) -> Floats:
    """The last states (m, history, d_s), newest first, padded by the first of the episode.

    Parameters
    ----------
    ds : TrajectoryDataset
    episode, state : ndarray of shape (m,)
        Episode, and row of ``ds.states`` that is the newest.
    history : int
    """
    back = state[:, None] - np.arange(history)
    return ds.states[np.maximum(back, ds.offsets[episode][:, None])]


def past_actions(ds: TrajectoryDataset, episode: Ints, state: Ints, history: int) -> Floats:
    """Actions (m, history - 1, d_a) between those states, newest first; zero before the first."""
    back = state[:, None] - np.arange(1, history)
    known = back >= ds.offsets[episode][:, None]
    if ds.actions is None:
        raise MissingFieldError(
            "the episodes have no actions before a state, which history= reads. Give them, or "
            "forecast from the first state."
        )
    # an episode has one action less than states
    step = np.where(known, back - episode[:, None], 0)
    return np.where(known[..., None], ds.actions[step], 0.0)


def state_names(names: tuple[str, ...], history: int) -> tuple[str, ...]:
    """Names of the columns of `differences`."""
    return tuple(f"change of {name}-{j}" for j in range(1, history) for name in names)


def action_names(names: tuple[str, ...], history: int) -> tuple[str, ...]:
    """Names of the columns of `past_actions`."""
    return tuple(f"{name}-{j}" for j in range(1, history) for name in names)
