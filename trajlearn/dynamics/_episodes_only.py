"""Forecasters that take whole episodes, and no rows."""

from typing import Any

from sklearn.utils import Tags

from trajlearn._persistence import SaveMixin
from trajlearn.dynamics._forecaster import Forecaster
from trajlearn.trajectories import Trajectory, TrajectoryDataset, as_dataset, is_episodes

__all__ = ["EpisodesOnly"]


class EpisodesOnly(SaveMixin, Forecaster):
    """Forecaster to which plain rows mean nothing."""

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        return tags

    def score(self, X: Any, y: None = None, sample_weight: Any = None) -> float:
        """Minus the range-normalised squared error, averaged over horizon and episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
        sample_weight : array-like of shape (n,), optional

        Returns
        -------
        float
            Greater is better; a diverged episode counts `error_score`.
        """
        return self._score_episodes(self._episodes(X), sample_weight)

    def _episodes(self, X: Any, y: Any = None) -> TrajectoryDataset:
        """`X` as a dataset, or an error that says what it is instead."""
        if y is not None:
            raise ValueError("y must be omitted: the targets come from the episodes themselves.")
        if isinstance(X, (list, tuple)) and not len(X):
            raise ValueError("X is empty: give at least one episode.")
        if not (is_episodes(X) or isinstance(X, Trajectory)):
            raise TypeError(
                f"{type(self).__name__} takes whole episodes, and got {type(X).__name__}: give a "
                "TrajectoryDataset or a list of Trajectory, not rows. "
                "TrajectoryDataset.from_arrays(states, ...) or from_frame(table, ...) builds one."
            )
        return as_dataset(X)
