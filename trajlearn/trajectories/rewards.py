"""Rewards of an episode from a function of its states, or as logged."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.trajectory import Trajectory

__all__ = ["Reward", "episode_rewards", "rewards_of", "step_rewards"]

Reward = Callable[..., NDArray[np.float64]]
_MAY_NAME = ("actions", "references", "times")


def step_rewards(
    reward: Reward, states: NDArray[np.float64], **signals: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Reward of each step, of the shape of `states` less its last axis.

    Parameters
    ----------
    reward : callable
        ``reward(states)``; it may also name `actions`, `references`, `times` as parameters.
    states : ndarray of shape (..., d_s)
        The state each step leads into.
    **signals : ndarray or None
        Values of the other names; an action is that of the step.

    Raises
    ------
    MissingFieldError
        If `reward` names a signal that is not there.
    ValueError
        If the result has another shape or is not finite where the states are.
    """
    wanted = [name for name in inspect.signature(reward).parameters if name in _MAY_NAME]
    absent = [name for name in wanted if signals.get(name) is None]
    if absent:
        raise MissingFieldError(
            f"the reward function names {absent}, which are not known here. Give them with the "
            "episodes, or use a reward of the states alone."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.asarray(
            reward(states, **{name: signals[name] for name in wanted}), dtype=np.float64
        )
    if values.shape != states.shape[:-1]:
        raise ValueError(
            f"the reward function returned shape {values.shape} for states of shape "
            f"{states.shape}; expected {states.shape[:-1]} (one number a state)."
        )
    if np.isnan(values[np.isfinite(states).all(axis=-1)]).any():
        raise ValueError("the reward function returned NaN for finite states.")
    return values


def episode_rewards(
    ds: TrajectoryDataset,
    reward: Reward | None = None,
    *,
    start: int = 0,
    horizon: int | None = None,
    terminal_reward: float | None = None,
) -> NDArray[np.float64]:
    """Mean reward per step of each episode over a common horizon (n,).

    Parameters
    ----------
    ds : TrajectoryDataset
    reward : callable or None
        None takes the logged rewards.
    start : int, default=0
        First step.
    horizon : int or None
        Number of steps; None takes all steps of the longest episode.
    terminal_reward : float or None
        What an episode that terminated early gets for each missing step, so that crashing
        early never pays.

    Raises
    ------
    ValueError
        If an episode is shorter than the horizon and nothing says what its missing steps are
        worth.
    """
    if reward is None:
        ds.require("rewards", by="the logged reward")
    steps = int(ds.lengths.max()) - start if horizon is None else int(horizon)
    if steps < 1:
        raise ValueError(f"start {start} leaves no step, or horizon {horizon} is below 1.")
    sums = np.empty(len(ds))
    for i, episode in enumerate(ds):
        values = rewards_of(episode, reward)[start : start + steps]
        sums[i] = values.sum() + _missing(episode, steps - len(values), terminal_reward)
    return sums / steps


def rewards_of(episode: Trajectory, reward: Reward | None) -> NDArray[np.float64]:
    """Reward of each step of an episode (T,), from a function or, if None, as logged."""
    if reward is None:
        assert episode.rewards is not None  # checked once for the dataset
        return episode.rewards
    signals: dict[str, Any] = {"actions": episode.actions, "times": episode.times[1:]}
    if episode.references is not None:
        signals["references"] = episode.references[1:]
    return step_rewards(reward, episode.states[1:], **signals)


def _missing(episode: Trajectory, n_missing: int, terminal_reward: float | None) -> float:
    if not n_missing:
        return 0.0
    if not episode.terminated:
        raise ValueError(
            f"episode {episode.id} has {episode.length} steps, {n_missing} fewer than the "
            "horizon, and did not terminate by itself, so its missing rewards are unknown: give "
            "a shorter horizon= or leave it out."
        )
    if terminal_reward is None:
        raise ValueError(
            f"episode {episode.id} terminated {n_missing} steps before the horizon: give "
            "terminal_reward= (what each missing step is worth), or episodes of equal length."
        )
    return n_missing * float(terminal_reward)
