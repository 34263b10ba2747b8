"""Stretches of episodes: how ids, groups and ends behave when an episode is cut."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._arrays import unique_ids
from trajlearn.trajectories._columns import Columns
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["constant_stretches", "cut", "like", "pieces", "theta_changes"]

Index = NDArray[np.intp]


def like(ds: TrajectoryDataset, columns: Columns) -> TrajectoryDataset:
    """Dataset of valid columns with the names of `ds`."""
    return TrajectoryDataset._of(columns.canonical().freeze(), ds._names)


def cut(columns: Columns, episode: Index, start: Index, steps: Index) -> Columns:
    """Stretches of episodes; only one that reaches the end is terminated."""
    stretches = columns.cut(episode, start, steps)
    at_end = start + steps == columns.lengths[episode]
    return Columns(**(vars(stretches) | {"terminated": stretches.terminated & at_end}))


def pieces(columns: Columns, episode: Index, start: Index, steps: Index) -> Columns:
    """Stretches with ids of their own and a group that keeps those of an episode together."""
    ids = columns.ids.tolist()
    names = [f"{ids[i]}:{first}" for i, first in zip(episode, start, strict=True)]
    group = columns.ids if columns.group is None else columns.group
    stretches = cut(columns, episode, start, steps)
    new = {"ids": np.array(unique_ids(names)), "group": group[episode]}
    return Columns(**(vars(stretches) | new))


def theta_changes(ds: TrajectoryDataset) -> tuple[Index, Index]:
    """Episode and index of every state from which on another theta is in force."""
    theta, offsets = ds._columns.params, ds._columns.step_offsets
    if theta is None or not ds.params_vary:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    rows = np.flatnonzero((theta[1:] != theta[:-1]).any(axis=1)) + 1
    rows = np.setdiff1d(rows, offsets)
    episode = np.searchsorted(offsets, rows, side="right") - 1
    return episode, rows - offsets[episode]


def constant_stretches(
    ds: TrajectoryDataset,
    chosen: Index,
    long_enough: Callable[[Columns], NDArray[np.bool_]],
    need: str,
) -> Columns:
    """Split the `chosen` episodes where theta changes; without stretches that are too short.

    Raises
    ------
    InvalidEpisodeError
        If an episode is too short as a whole, or none of its stretches is long enough.
    """
    columns = ds._columns
    enough = long_enough(columns)
    if not enough.all():
        raise InvalidEpisodeError(
            f"episode {ds.ids[np.argmin(enough)]} is shorter than {need}. Leave such episodes out, "
            "or ask for a smaller step."
        )
    if not len(chosen):
        return columns
    episode, change = theta_changes(ds)
    inside = np.isin(episode, chosen)
    begin = columns.step_offsets[:-1]
    rows = np.sort(np.concatenate([begin, (begin[episode] + change)[inside]]))
    steps = np.diff(np.append(rows, columns.step_offsets[-1]))
    owner = np.searchsorted(columns.step_offsets, rows, side="right") - 1
    stretches = pieces(columns, owner, rows - begin[owner], steps)
    enough = long_enough(stretches)
    lost = np.setdiff1d(np.arange(len(ds)), owner[enough])
    if len(lost):
        raise InvalidEpisodeError(
            f"episode {ds.ids[lost[0]]}: every stretch of constant theta is shorter than {need}. "
            "Leave such episodes out, or ask for a smaller step."
        )
    return stretches.take(np.flatnonzero(enough))
