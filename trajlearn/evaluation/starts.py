"""Where to begin forecasts inside episodes of unequal length."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.evaluation._matching import SAME_TIME
from trajlearn.trajectories import TrajectoryDataset, as_dataset

__all__ = ["starts_every"]

Ints = NDArray[np.intp]


def starts_every(
    ds: TrajectoryDataset, stride: int, *, first: ArrayLike | str = 0, horizon: int = 1
) -> list[Ints]:
    """Every `stride`-th state of each episode, for ``predict(ds, start=...)``.

    Parameters
    ----------
    ds : TrajectoryDataset or list of Trajectory
    stride : int
        Steps from one start to the next.
    first : int, array-like of shape (n,) or "motion", default=0
        Index of the first start: one, one per episode, or the first state at or after
        ``ds.time_origin``.
    horizon : int, default=1
        Steps of the log that have to remain after a start.

    Returns
    -------
    list of n arrays
        Indices of states, of unequal number; none for an episode that is too short.

    Raises
    ------
    ValueError
        If `stride` or `horizon` is below 1, `first` is negative, of the wrong shape or "motion"
        where an origin is unknown, or no episode is long enough.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays([np.zeros((30, 1)), np.zeros((12, 1))])
    >>> [start.tolist() for start in starts_every(ds, 10)]
    [[0, 10, 20], [0, 10]]
    >>> [start.tolist() for start in starts_every(ds, 10, first=5, horizon=10)]
    [[5, 15], []]
    """
    ds = as_dataset(ds)
    for name, value in (("stride", stride), ("horizon", horizon)):
        if isinstance(value, bool) or int(value) != value or value < 1:
            raise ValueError(f"{name} = {value!r} must be a whole number of steps, at least 1.")
    begin = _first(ds, first)
    starts = [np.arange(b, last + 1, stride) for b, last in zip(begin, ds.lengths - horizon)]
    if not any(len(start) for start in starts):
        raise ValueError(
            f"no episode has {horizon} steps after its first start; the longest has "
            f"{(ds.lengths - begin).max()}. Begin earlier or ask for fewer."
        )
    return starts


def _first(ds: TrajectoryDataset, first: ArrayLike | str) -> Ints:
    if isinstance(first, str):
        if first != "motion":
            raise ValueError(f'first = {first!r}; give an index, one per episode, or "motion".')
        return _motion_starts(ds)
    begin = np.asarray(first)
    if begin.dtype.kind not in "iu" or begin.shape not in ((), (len(ds),)) or (begin < 0).any():
        raise ValueError(
            f"first = {first!r} must be an index from 0 on, or one per episode ({len(ds)},)."
        )
    return np.broadcast_to(begin.astype(np.intp), (len(ds),))


def _motion_starts(ds: TrajectoryDataset) -> Ints:
    """First state at or after the time origin; beyond the episode where there is none."""
    unknown = np.isnan(ds.time_origin)
    if unknown.any():
        raise ValueError(
            f"time_origin is unknown in {unknown.sum()} episodes, the first of them "
            f"{ds.ids[unknown][0]}: leave them out, ds[~np.isnan(ds.time_origin)], or give first=."
        )
    duration = ds.times[ds.offsets[1:] - 1] - ds.times[ds.offsets[:-1]]
    origin = ds.time_origin - SAME_TIME * duration / ds.lengths
    return np.array(
        [
            np.searchsorted(ds.times[low:high], t)
            for low, high, t in zip(ds.offsets[:-1], ds.offsets[1:], origin)
        ]
    )
