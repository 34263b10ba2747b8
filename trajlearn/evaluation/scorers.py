"""Scores at one horizon, for scikit-learn's model selection."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from trajlearn.evaluation._horizons import errors_at, whole_steps
from trajlearn.trajectories import as_dataset

__all__ = ["horizon_scorer"]


def horizon_scorer(horizon: int, *, error_score: float = -1e12) -> "HorizonScorer":
    """Scorer for `GridSearchCV`, `cross_validate` and their kin: accuracy at one horizon.

    Minus the squared error at `horizon`, in training ranges and averaged over states, averaged
    over the test episodes that reach the horizon. Greater is better, 0 is perfect.

    Parameters
    ----------
    horizon : int
        Steps ahead, from the first state of each episode.
    error_score : float, default=-1e12
        What an episode counts whose forecast has diverged by then; no episode counts less. With
        NaN one divergence makes the score NaN, which scikit-learn ranks last.

    Returns
    -------
    callable
        ``scorer(estimator, X, y=None) -> float``; picklable, also in dictionaries of scorers.

    Raises
    ------
    ValueError
        If `horizon` is not a whole number of at least 1, or `error_score` is above 0. When
        called: if no episode reaches the horizon.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression, Ridge
    >>> from sklearn.model_selection import GridSearchCV
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> search = GridSearchCV(
    ...     TrajectoryRegressor(random_state=0),
    ...     {"estimator": [LinearRegression(), Ridge(1e6)]},
    ...     scoring={"near": horizon_scorer(1), "far": horizon_scorer(6)},
    ...     refit="far",
    ...     cv=3,
    ... ).fit(ds)
    >>> search.best_params_
    {'estimator': LinearRegression()}
    """
    steps = whole_steps(horizon, "horizon")
    if np.ndim(horizon):
        raise ValueError(f"horizon = {horizon!r}: give one number; use a dictionary of scorers.")
    if error_score > 0:
        raise ValueError(f"error_score = {error_score} must not exceed 0, the perfect score.")
    return HorizonScorer(int(steps[0]), float(error_score))


@dataclass(frozen=True, repr=False)
class HorizonScorer:
    """What `horizon_scorer` returns."""

    horizon: int
    error_score: float

    def __call__(self, estimator: Any, X: Any, y: None = None) -> float:
        """Score a fitted estimator on episodes."""
        if y is not None:
            raise ValueError(f"{self!r} scores episodes alone: omit y.")
        ds = as_dataset(X)
        table = errors_at(estimator, ds, whole_steps(self.horizon, "horizon"))
        errors = table[self.horizon].dropna().to_numpy()
        if not len(errors):
            raise ValueError(
                f"{self!r}: no forecast of the {len(ds)} test episodes reaches horizon "
                f"{self.horizon} (the longest episode has {ds.lengths.max()} steps). Choose a "
                "shorter horizon, or folds with longer episodes."
            )
        # fmax: an error_score of NaN is for diverged episodes only
        scores = np.where(errors == np.inf, self.error_score, np.fmax(-errors, self.error_score))
        return float(scores.mean())

    def __repr__(self) -> str:
        other = "" if self.error_score == -1e12 else f", error_score={self.error_score:g}"
        return f"horizon_scorer({self.horizon}{other})"
