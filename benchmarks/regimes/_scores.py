"""Errors of a forecast by horizon, in one way for all models, peers included."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.regimes._episodes import Episodes
from trajlearn import TrajectoryDataset

Floats = NDArray[np.float64]

#: Ends of the blocks of horizons, as shares of the length of an episode.
BLOCK_ENDS = (0.025, 0.125, 0.375, 0.75, 1.0)
# shares of the length at which errors are stored, beside the first steps
_SHARES = np.r_[0.04, 0.05, 0.0625, 0.075, 0.1, 0.125, 0.15, 0.2, 0.25, np.linspace(0.3, 1.0, 15)]
_FIRST = (1, 2, 3, 5)


def shown_horizons(length: int) -> list[int]:
    """Horizons at which errors are stored: dense at first, then even."""
    found = {*_FIRST, *np.rint(_SHARES * length).astype(int).tolist()}
    return sorted(h for h in found if 1 <= h <= length)


def block_of(horizon: int, length: int) -> int:
    """Number of the block that a horizon is in; none is empty."""
    ends = [max(round(end * length), i + 1) for i, end in enumerate(BLOCK_ENDS[:-1])]
    return sum(horizon > end for end in ends)


def errors_of(mean: Floats, truth: TrajectoryDataset, span: Floats) -> Floats:
    """Squared errors (n, H) of predicted states (n, H, d_s), averaged over the states.

    Parameters
    ----------
    mean : ndarray of shape (n, H, d_s)
        Infinite or NaN after a divergence.
    truth : TrajectoryDataset
        An episode that is shorter than H counts as far as it goes.
    span : ndarray of shape (d_s,)
        What an error of 1 is in each state.
    """
    errors = np.full(mean.shape[:2], np.nan)
    for row, predicted, episode in zip(errors, mean, truth, strict=True):
        n = min(episode.length, len(predicted))
        with np.errstate(over="ignore", invalid="ignore"):
            off = (predicted[:n] - episode.states[1 : n + 1]) / span
            squared = (off**2).mean(axis=1)
        row[:n] = np.where(np.isfinite(squared), squared, np.inf)
    return errors


def scores(mean: Floats, data: Episodes) -> dict[str, Any]:
    """Errors of predicted states, over all test episodes and over two halves of them.

    Returns
    -------
    dict
        ``cum``: mean over episodes and horizons; ``reward``: mean squared error of the mean
        reward of an episode, None where there is no reward; ``n_diverged``; ``curve``: lists by
        `shown_horizons`, of ``mean`` and ``median`` over episodes, and of both over the even and
        the odd episodes (``mean_0``, ``mean_1``, ...); ``blocks``: mean over the horizons of a
        block of the median over episodes.
    """
    errors = errors_of(mean, data.truth, data.span)
    length = errors.shape[1]
    horizons = shown_horizons(length)
    at = errors[:, np.array(horizons) - 1]
    curve: dict[str, Any] = {"horizon": horizons}
    for name, some in {"": at, "_0": at[::2], "_1": at[1::2]}.items():
        curve[f"mean{name}"] = _over_episodes(some, np.mean)
        curve[f"median{name}"] = _over_episodes(some, np.median)
    medians = np.array(_over_episodes(errors, np.median))
    block = np.array([block_of(h, length) for h in range(1, length + 1)])
    return {
        "cum": float(np.mean(_over_episodes(errors, np.mean))),
        "reward": _reward_error(mean, data),
        "n_diverged": int(np.isinf(errors).any(axis=1).sum()),
        "curve": curve,
        "blocks": [float(medians[block == b].mean()) for b in range(len(BLOCK_ENDS))],
    }


def _over_episodes(errors: Floats, statistic: Any) -> list[float]:
    """A statistic of each column, over the episodes that reach it."""
    return [float(statistic(column[~np.isnan(column)])) for column in errors.T]


def _reward_error(mean: Floats, data: Episodes) -> float | None:
    if data.reward is None:
        return None
    missed = []
    for predicted, episode in zip(mean, data.truth, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            guess = float(data.reward(predicted[: episode.length]).mean())
        off = guess - float(data.reward(episode.states[1:]).mean())
        missed.append(off**2 if np.isfinite(off) else np.inf)
    return float(np.mean(missed))
