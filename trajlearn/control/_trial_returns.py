"""Returns of trials that were run: summed up, given by hand, or summed up again."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.control._trials import Trials
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.rewards import Reward, rewards_of

__all__ = ["check_same_reward", "measured", "warn_of_ends"]

Floats = NDArray[np.float64]

# two sums of the same rewards, of which one was logged in single precision
_ROUNDING = 1e-6


def measured(
    state: Trials, ds: TrajectoryDataset, reward: Reward | None, given: ArrayLike | None
) -> dict[str, NDArray[Any]]:
    """Records of new trials.

    Raises
    ------
    ValueError
        If a return is unknown or not finite; the message names the trial.
    """
    n = len(ds)
    params = np.stack([_one_theta(ds, i, state.horizon) for i in range(n)])
    by_hand = _given_returns(given, params)
    if by_hand is None and reward is None:
        ds.require("rewards", by="reward=None (the logged reward)")
    total, least, missing = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, dtype=np.intp)
    for i, episode in enumerate(ds):
        if by_hand is not None:
            total[i] = by_hand[i]
            continue
        rewards = rewards_of(episode, reward)[: state.horizon]
        if not np.isfinite(rewards).all():
            raise ValueError(
                f"trial {episode.id}: a step has the reward {rewards[~np.isfinite(rewards)][0]}, "
                "so the trial has no return: mend the reward function, or give reward=."
            )
        least[i] = rewards.min()
        if np.isnan(params[i]).any():
            continue
        total[i], missing[i] = rewards.sum(), state.horizon - len(rewards)
        if missing[i] and not episode.terminated:
            raise ValueError(
                f"trial {episode.id} has {episode.length} steps, fewer than the horizon of "
                f"{state.horizon}, and did not terminate by itself, so its return is unknown: log "
                "it longer, set terminated=True if it crashed, or give its return as reward=."
            )
    return {
        "params": params,
        "total": total,
        "least": least,
        "missing": missing,
        **_predicted(state, params),
    }


def check_same_reward(state: Trials, reward: Reward | None) -> None:
    """Raise if a reward gives other returns than those of the trials, apart from given ones.

    Raises
    ------
    ValueError
        The message names the trial and both returns.
    """
    data = state.data
    # logged rewards of some trials only are not kept
    if data is None or (reward is None and data.rewards is None):
        return
    total, least = state.records["total"], state.records["least"]
    for i in np.flatnonzero(~np.isnan(least)):
        rewards = rewards_of(data[int(i)], reward)[: state.horizon]
        # where theta changes there is no return, but a least reward
        known, found, what = (
            (least[i], rewards.min(), "least step reward")
            if np.isnan(total[i])
            else (total[i], rewards.sum(), "sum of rewards")
        )
        if not abs(found - known) <= _ROUNDING * np.abs(rewards).sum():
            raise ValueError(
                f"the reward is another one than before: the {what} of trial {i} is {found:.6g} "
                f"with this one and was {known:.6g}. Give the same reward=, or build a new search "
                "and tell it the trials (trials_) instead."
            )


def _one_theta(ds: TrajectoryDataset, i: int, horizon: int) -> Floats:
    """Theta of a trial (p,), NaN if it changes before the horizon."""
    theta = ds[i].params
    if theta.ndim == 1:
        return theta
    steps = theta[:horizon]
    return steps[0] if (steps == steps[0]).all() else np.full(theta.shape[1], np.nan)


def _given_returns(given: ArrayLike | None, params: Floats) -> Floats | None:
    if given is None:
        return None
    values = np.asarray(given, dtype=np.float64)
    if values.ndim == 0 and len(params) == 1:
        values = values[None]
    if values.shape != (len(params),):
        raise ValueError(
            f"reward has shape {values.shape}: give one return for each of the {len(params)} "
            "trial(s)."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"reward = {values[~np.isfinite(values)][0]} must be finite.")
    if np.isnan(params).any():
        raise ValueError(
            "theta changes during a trial, so there is no theta that its return belongs to: leave "
            "reward= out, the trial then only serves the model."
        )
    return values


def _predicted(state: Trials, params: Floats) -> dict[str, NDArray[Any]]:
    """What was predicted of the trials that follow the proposal; others were logged elsewhere."""
    n, proposal = len(params), state.pending
    predicted: dict[str, NDArray[Any]] = {
        name: np.full(n, np.nan) for name in ("predicted", "expected", "std", "violation")
    }
    source = np.full(n, "logged", dtype="U32")
    if proposal is not None:
        # files and robots round
        span = state.bounds[:, 1] - state.bounds[:, 0]
        follows = (np.abs(params - proposal.params) <= 1e-6 * span).all(axis=1)
        values = (proposal.reward, proposal.expected, proposal.std, proposal.violation)
        for name, value in zip(predicted, values, strict=True):
            predicted[name][follows] = np.nan if value is None else value
        source[follows] = proposal.source
    return predicted | {"source": source}


def warn_of_ends(ds: TrajectoryDataset, is_terminal: Any, horizon: int) -> None:
    """Warn where trials ended early, but nothing says where predicted ones do."""
    early = ds.terminated & (ds.lengths < horizon)
    if is_terminal is None and early.any():
        warnings.warn(
            f"{early.sum()} trial(s) ended early, but is_terminal=None: predicted trials go on to "
            "the horizon whatever happens. Give is_terminal= and terminal_reward=, so that a "
            "predicted end costs what a real one does.",
            UserWarning,
            stacklevel=4,
        )
