"""Scores by horizon, for scikit-learn's model selection."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.evaluation._horizons import errors_at, predicted_states, whole_steps
from trajlearn.evaluation._statistics import mean
from trajlearn.evaluation.uncertainty import crps
from trajlearn.trajectories import TrajectoryDataset, as_dataset

__all__ = ["crps_scorer", "horizon_scorer"]


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
    return HorizonScorer(_one_horizon(horizon), _checked_error_score(error_score))


def crps_scorer(horizon: int | None = None, *, error_score: float = -1e12) -> "CRPSScorer":
    """Scorer for `GridSearchCV`, `cross_validate` and their kin: quality of the uncertainty.

    Minus the continuous ranked probability score (`crps`), in training ranges and averaged over
    states and, without `horizon`, over the steps of an episode; then over the test episodes.
    Greater is better, 0 is a perfect forecast that is sure of itself. It calls
    ``predict(X, return_std=True)``.

    Parameters
    ----------
    horizon : int, optional
        Steps ahead, from the first state of each episode. Default: all steps.
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
        called: if no episode reaches the horizon, or the estimator has no uncertainty.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from sklearn.model_selection import cross_val_score
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0)
    >>> scores = cross_val_score(model, ds, scoring=crps_scorer(6), cv=3)
    >>> scores.shape, bool((scores < 0).all())
    ((3,), True)
    """
    at = None if horizon is None else _one_horizon(horizon)
    return CRPSScorer(at, _checked_error_score(error_score))


def _one_horizon(horizon: int) -> int:
    steps = whole_steps(horizon, "horizon")
    if np.ndim(horizon):
        raise ValueError(f"horizon = {horizon!r}: give one number; use a dictionary of scorers.")
    return int(steps[0])


def _checked_error_score(error_score: float) -> float:
    if error_score > 0:
        raise ValueError(f"error_score = {error_score} must not exceed 0, the perfect score.")
    return float(error_score)


@dataclass(frozen=True, repr=False)
class _EpisodeScorer:
    """Minus the mean of a loss an episode."""

    horizon: int | None
    error_score: float

    def __call__(self, estimator: Any, X: Any, y: None = None) -> float:
        """Score a fitted estimator on episodes."""
        if y is not None:
            raise ValueError(f"{self!r} scores episodes alone: omit y.")
        ds = as_dataset(X)
        losses = self._losses(estimator, ds)
        losses = losses[~np.isnan(losses)]
        if not len(losses):
            raise ValueError(
                f"{self!r}: no forecast of the {len(ds)} test episodes reaches horizon "
                f"{self.horizon} (the longest episode has {ds.lengths.max()} steps). Choose a "
                "shorter horizon, or folds with longer episodes."
            )
        # fmax: an error_score of NaN is for diverged episodes only
        scores = np.where(losses == np.inf, self.error_score, np.fmax(-losses, self.error_score))
        return float(scores.mean())

    def _losses(self, estimator: Any, ds: TrajectoryDataset) -> NDArray[np.float64]:
        """Loss of each episode: NaN where it does not reach the horizon, inf where diverged."""
        raise NotImplementedError

    def _repr(self, name: str) -> str:
        arguments = [] if self.horizon is None else [str(self.horizon)]
        if self.error_score != -1e12:
            arguments.append(f"error_score={self.error_score:g}")
        return f"{name}({', '.join(arguments)})"


class HorizonScorer(_EpisodeScorer):
    """What `horizon_scorer` returns."""

    def _losses(self, estimator: Any, ds: TrajectoryDataset) -> NDArray[np.float64]:
        (errors,) = errors_at(estimator, ds, np.array([self.horizon])).to_numpy().T
        return errors

    def __repr__(self) -> str:
        return self._repr("horizon_scorer")


class CRPSScorer(_EpisodeScorer):
    """What `crps_scorer` returns."""

    def _losses(self, estimator: Any, ds: TrajectoryDataset) -> NDArray[np.float64]:
        if self.horizon is not None:
            # cut instead of horizon=: shorter episodes are then not forecast past their end
            ds = ds.truncate(self.horizon)
        forecast = predicted_states(estimator, ds, return_std=True)
        if self.horizon is not None:
            if self.horizon not in forecast.horizons:
                return np.full(len(ds), np.nan)
            forecast = forecast.at(self.horizon)
        scores = crps(forecast, ds)
        return mean(np.moveaxis(scores, 0, -1).reshape(-1, len(scores)))

    def __repr__(self) -> str:
        return self._repr("crps_scorer")
