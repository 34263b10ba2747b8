"""Velocities that nobody logged, as a part of the state: a first guess, from positions alone."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import SmoothingWarning
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import Columns
from trajlearn.trajectories.kalman import KalmanSmoother

__all__ = ["guessed_velocities", "with_velocities"]

Floats = NDArray[np.float64]


def with_velocities(ds: TrajectoryDataset) -> TrajectoryDataset:
    """The episodes with rates of change after the states: to the next state, over its time.

    They are called ``d_<name>``, as `KalmanSmoother` calls them.
    """
    return _appended(ds, _rates(ds, ds.states, behind=0, ahead=1))


def guessed_velocities(ds: TrajectoryDataset) -> tuple[list[TrajectoryDataset], Floats]:
    """Episodes with velocities of more than one definition, and a guess of the noise.

    They are differences of positions that a model of motion has smoothed. A plant that is
    simulated in steps of Euler's method has velocities that lead to the next position; others have
    them between the position before and the next.

    Returns
    -------
    list of TrajectoryDataset
    variance : ndarray of shape (m,)
        Of the measurement noise.

    Raises
    ------
    ValueError
        If velocities are among the states already, or no episode has three states.
    """
    logged = [name for name in ds.state_names if f"d_{name}" in ds.state_names]
    if logged:
        raise ValueError(
            f"latent_velocities=True takes positions, but the states have d_{logged[0]} beside "
            f"{logged[0]}: select the positions (ds.select_states), or leave it out."
        )
    if ds.lengths.max() < 2:
        raise ValueError(
            "latent_velocities=True needs episodes of two steps or more: a single difference of "
            "positions does not tell motion from noise."
        )
    smoother = KalmanSmoother()
    with warnings.catch_warnings():
        # what follows is a better model of the motion
        warnings.simplefilter("ignore", SmoothingWarning)
        smooth = smoother.fit_transform(ds).states
    variance = np.array([smoother.measurement_noise_[name] ** 2 for name in ds.state_names])
    reach = [(0, 1), (1, 1)]
    return [_appended(ds, _rates(ds, smooth, behind=b, ahead=a)) for b, a in reach], variance


def _rates(ds: TrajectoryDataset, states: Floats, *, behind: int, ahead: int) -> Floats:
    """Differences of states over some samples, within each episode; one-sided at its ends."""
    row = np.arange(len(states))
    first = np.repeat(ds.offsets[:-1], ds.lengths + 1)
    last = first + np.repeat(ds.lengths, ds.lengths + 1)
    begin, end = np.maximum(row - behind, first), np.minimum(row + ahead, last)
    # the last state has nothing ahead
    begin = np.where(begin == end, begin - 1, begin)
    rates: Floats = (states[end] - states[begin]) / (ds.times[end] - ds.times[begin])[:, None]
    return rates


def _appended(ds: TrajectoryDataset, rates: Floats) -> TrajectoryDataset:
    new: dict[str, Any] = {"states": np.concatenate([ds.states, rates], axis=1)}
    names = dict(ds._names)
    names["states"] = (*ds.state_names, *(f"d_{name}" for name in ds.state_names))
    if ds.observed is None:
        new["observed"], names["observed"] = ds.states, ds.state_names
    columns = Columns(**(vars(ds._columns) | new))
    return TrajectoryDataset._of(columns.freeze(), names)
