"""What a prediction is to be compared with: logged states, or one score an episode."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics import Forecast
from trajlearn.dynamics.forecast import shared_states
from trajlearn.trajectories import TrajectoryDataset, as_dataset

__all__ = [
    "SAME_TIME",
    "check_same_times",
    "check_truth_kind",
    "episode_of",
    "matched_scores",
    "with_states_of",
]

Floats = NDArray[np.float64]

# two samples further apart than this, in mean steps of the episode, are different samples
SAME_TIME = 1e-3

_TRUTH_KINDS = ("observed", "true")


def episode_of(forecast: Forecast) -> NDArray[np.intp]:
    """Position of the episode of each forecast (n,)."""
    return np.arange(len(forecast)) if forecast.episode is None else forecast.episode


def with_states_of(forecast: Forecast, truth: Any) -> TrajectoryDataset:
    """`truth` with the logged states that were forecast, in the order of the forecast.

    A pipeline may have selected some states, estimated others that were never logged (these have
    no column here), or replaced them by smoothed ones (`observed` takes their place).
    """
    ds = as_dataset(truth)
    _, names, logged = shared_states(forecast.state_names, ds)
    if ds.observed is None and names == ds.state_names:
        return ds
    columns = replace(ds._columns, states=np.ascontiguousarray(logged), observed=None)
    kept = {field: value for field, value in ds._names.items() if field != "observed"}
    return TrajectoryDataset._of(columns.freeze(), kept | {"states": names})


def check_same_times(forecast: Forecast, truth: TrajectoryDataset) -> None:
    """Refuse to compare forecasts with samples of other episodes or another sampling.

    Raises
    ------
    ValueError
        Naming the first episode whose logged times differ from those of its forecast.
    """
    episode = episode_of(forecast)
    first, last = truth.offsets[:-1][episode], truth.offsets[1:][episode] - 1
    steps = forecast.start[:, None] + forecast.horizons
    known = (steps <= (last - first)[:, None]) & np.isfinite(forecast.times)
    logged = truth.times[first[:, None] + np.where(known, steps, 0)]
    tolerance = SAME_TIME * (truth.times[last] - truth.times[first]) / (last - first)
    late = np.abs(np.where(known, forecast.times - logged, 0.0))
    if (late > tolerance[:, None]).any():
        i, j = np.argwhere(late > tolerance[:, None])[0]
        raise ValueError(
            f"forecast {i} is for time {forecast.times[i, j]:g} at horizon "
            f"{forecast.horizons[j]}, but episode {truth.ids[episode[i]]} was logged at "
            f"{logged[i, j]:g}: give the episodes that were forecast, in their order and sampling."
        )


def check_truth_kind(truth_kind: str) -> None:
    """Refuse a word that does not say what the true states are."""
    if truth_kind not in _TRUTH_KINDS:
        raise ValueError(f'truth_kind = {truth_kind!r}; choose "observed" or "true".')


def matched_scores(predicted: ArrayLike, true: ArrayLike, what: str) -> tuple[Floats, Floats]:
    """Both as (n,) arrays; a prediction may be infinite, a true score may not.

    Raises
    ------
    ValueError
        If the shapes are not the same (n,), or a value is NaN or a true one infinite.
    """
    guess, target = (np.asarray(values, dtype=np.float64) for values in (predicted, true))
    if guess.ndim != 1 or guess.shape != target.shape or not len(guess):
        raise ValueError(
            f"predicted has shape {guess.shape}, true {target.shape}: give one {what} an episode, "
            "both of shape (n,); a column (n, 1) needs .ravel()."
        )
    if np.isnan(guess).any() or not np.isfinite(target).all():
        raise ValueError(
            f"predicted has NaN, or true has NaN or infinite values; a forecast that diverged has "
            f"an infinite {what}, and every episode needs a true {what}."
        )
    return guess, target
