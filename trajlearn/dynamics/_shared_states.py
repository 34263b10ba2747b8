"""Which states of a forecast were logged."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trajlearn.trajectories import TrajectoryDataset

__all__ = ["shared_states"]

Floats = NDArray[np.float64]


def shared_states(
    names: Sequence[str], truth: TrajectoryDataset
) -> tuple[NDArray[np.intp], tuple[str, ...], Floats]:
    """Which of the forecast states `names` were logged, and the logged values.

    Returns
    -------
    columns : ndarray of shape (k,)
        Positions in `names`.
    shared : tuple of str
        Names in `truth`.
    logged : ndarray of shape (sum of T + 1, k)

    Raises
    ------
    ValueError
        If the forecast and the episodes are of different states.
    """
    logged, known = truth.states, truth.state_names
    if truth.observed is not None:
        logged, known = truth.observed, truth.observed_names
    every = np.arange(len(names), dtype=np.intp)
    if tuple(names) == known:
        return every, known, logged
    shared = tuple(name for name in names if name in known)
    derived = [name for name in names if name not in known and not name.startswith("d_")]
    if shared and (not derived or len(shared) == len(known)):
        index = [known.index(name) for name in shared]
        return every[np.isin(names, shared)], shared, logged[:, index]
    if not shared and len(names) == len(known):
        return every, known, logged
    raise ValueError(
        f"the forecast has {len(names)} states ({', '.join(names)}), the episodes {len(known)} "
        f"({', '.join(known)}): give the episodes that were forecast, with the same names."
    )
