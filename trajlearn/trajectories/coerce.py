"""What estimators take as episodes: a dataset, or a list of trajectories."""

from typing import Any

from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.trajectory import Trajectory

__all__ = ["as_dataset", "is_episodes"]


def is_episodes(X: Any) -> bool:
    """Whether `X` is a dataset or a non-empty list of `Trajectory`."""
    if isinstance(X, TrajectoryDataset):
        return True
    return isinstance(X, (list, tuple)) and len(X) > 0 and isinstance(X[0], Trajectory)


def as_dataset(X: Any) -> TrajectoryDataset:
    """Return `X` as a dataset; a list of `Trajectory` is packed."""
    if isinstance(X, TrajectoryDataset):
        return X
    if isinstance(X, Trajectory):
        return TrajectoryDataset([X])
    if is_episodes(X):
        return TrajectoryDataset(list(X))
    raise TypeError(
        f"expected a TrajectoryDataset or a list of Trajectory, got {type(X).__name__}. Build one "
        "with TrajectoryDataset.from_arrays(states, ...) or from_frame(table, ...)."
    )
