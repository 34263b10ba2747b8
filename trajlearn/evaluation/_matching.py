"""The logged states that a forecast is to be compared with."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics import Forecast
from trajlearn.trajectories import TrajectoryDataset, as_dataset

__all__ = ["check_same_times", "episode_of", "with_states_of"]

# two samples further apart than this, in mean steps of the episode, are different samples
_SAME_TIME = 1e-3


def episode_of(forecast: Forecast) -> NDArray[np.intp]:
    """Position of the episode of each forecast (n,)."""
    return np.arange(len(forecast)) if forecast.episode is None else forecast.episode


def with_states_of(forecast: Forecast, truth: Any) -> TrajectoryDataset:
    """`truth` with the states that were forecast: a pipeline may have selected some of them."""
    ds = as_dataset(truth)
    if forecast.state_names != ds.state_names and set(forecast.state_names) <= set(ds.state_names):
        return ds.select_states(forecast.state_names)
    return ds


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
    tolerance = _SAME_TIME * (truth.times[last] - truth.times[first]) / (last - first)
    late = np.abs(np.where(known, forecast.times - logged, 0.0))
    if (late > tolerance[:, None]).any():
        i, j = np.argwhere(late > tolerance[:, None])[0]
        raise ValueError(
            f"forecast {i} is for time {forecast.times[i, j]:g} at horizon "
            f"{forecast.horizons[j]}, but episode {truth.ids[episode[i]]} was logged at "
            f"{logged[i, j]:g}: give the episodes that were forecast, in their order and sampling."
        )
