"""Time steps of episodes, free of round-off."""

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MixedSamplingError
from trajlearn.trajectories.dataset import TrajectoryDataset

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def time_steps(ds: TrajectoryDataset) -> Floats:
    """Time steps inside the episodes (sum of T,)."""
    inside = np.ones(len(ds.times) - 1, dtype=bool)
    inside[ds.offsets[1:-1] - 1] = False
    return np.diff(ds.times)[inside]


def _least_and_greatest(ds: TrajectoryDataset) -> tuple[Floats, Floats]:
    """Shortest and longest time step of each episode (n,)."""
    steps, first = time_steps(ds), ds.offsets[:-1] - np.arange(len(ds))
    return np.minimum.reduceat(steps, first), np.maximum.reduceat(steps, first)


def time_grids(ds: TrajectoryDataset) -> Floats:
    """Lines of each episode's time grid in a unit of time (n,).

    A power of ten that keeps differences of times exact to a millionth of the shortest step. It
    is the episode's own, so that an episode gets the same bits alone as among others.
    """
    shortest, _ = _least_and_greatest(ds)
    return 10.0 ** np.maximum(np.ceil(-np.log10(shortest)) + 6, 0)


def time_differences(ds: TrajectoryDataset, episode: Ints, begin: Ints, end: Ints) -> Floats:
    """Time from the states `begin` to `end` (rows of ``ds.states``), rounded to the time grid.

    ``(t + dt) - t`` differs from dt by round-off, which a scaler would blow up to order one.
    """
    grid = time_grids(ds)[episode]
    return np.rint((ds.times[end] - ds.times[begin]) * grid) / grid


def episode_steps(ds: TrajectoryDataset) -> Floats:
    """Time step of each episode (n,); NaN where it varies by more than a thousandth."""
    low, high = _least_and_greatest(ds)
    grid, middle = time_grids(ds), (low + high) / 2
    return np.where(high - low <= 1e-3 * middle, np.rint(middle * grid) / grid, np.nan)


def median_step(ds: TrajectoryDataset) -> float:
    """Median time step of all episodes."""
    grid = float(time_grids(ds).max())
    return float(np.rint(np.median(time_steps(ds)) * grid) / grid)


def uniform_step(ds: TrajectoryDataset) -> float:
    """The common time step of all episodes.

    Raises
    ------
    MixedSamplingError
        If the steps differ by more than a thousandth.
    """
    steps, dt = time_steps(ds), median_step(ds)
    if np.abs(steps - dt).max() > 1e-3 * dt:
        raise MixedSamplingError(
            f"the time step varies from {steps.min():g} to {steps.max():g}, so one step means "
            'different things. Add "dt" to inputs=, resample the episodes (ds.resample(dt)), or '
            "use TrajectoryRegressor, which takes any horizon."
        )
    return dt
