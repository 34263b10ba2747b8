"""What `fit` takes beside the episodes, one value an episode: groups and weights."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline
from sklearn.utils.validation import has_fit_parameter

from trajlearn.trajectories import TrajectoryDataset

__all__ = ["checked_weight", "in_groups", "weights_for"]

Floats = NDArray[np.float64]


def in_groups(ds: TrajectoryDataset, groups: ArrayLike | None) -> TrajectoryDataset:
    """The episodes with `groups`, if they are given, as their group.

    Raises
    ------
    ValueError
        If there is not one label an episode.
    """
    if groups is None:
        return ds
    labels = np.asarray(groups)
    if labels.shape != (len(ds),):
        raise ValueError(f"groups has shape {labels.shape}; give one label an episode ({len(ds)}).")
    return TrajectoryDataset._of(replace(ds._columns, group=labels), ds._names)


def checked_weight(sample_weight: ArrayLike, n_episodes: int) -> Floats:
    """Weights by episode (n,), not all of them zero.

    Raises
    ------
    ValueError
        If they are something else.
    """
    weight = np.asarray(sample_weight, dtype=np.float64)
    if weight.shape != (n_episodes,) or not np.isfinite(weight).all() or (weight < 0).any():
        raise ValueError(
            f"sample_weight needs one finite weight >= 0 an episode ({n_episodes}); got shape "
            f"{weight.shape}."
        )
    if not weight.any():
        raise ValueError("sample_weight is zero everywhere; give an episode some weight.")
    return weight


def weights_for(estimator: Any, weight: Floats) -> dict[str, Floats]:
    """Keywords that hand `weight` (n,) to `fit` of an estimator; none where all are equal.

    Of a `Pipeline` the last step gets them; what is frozen is not fitted, and needs none.

    Raises
    ------
    TypeError
        If the estimator takes no weights and they are not equal.
    """
    if isinstance(estimator, FrozenEstimator) or (weight == weight[0]).all():
        return {}
    learner, keyword = estimator, "sample_weight"
    if isinstance(estimator, Pipeline):
        step, learner = estimator.steps[-1]
        keyword = f"{step}__{keyword}"
    if not has_fit_parameter(learner, "sample_weight"):
        raise TypeError(
            f"episodes have different weights, but {type(learner).__name__} does not take "
            "sample_weight: weigh all alike, or choose an estimator that does."
        )
    return {keyword: weight}
