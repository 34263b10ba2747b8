"""Predicting relative to a baseline: fitting it without leaks, and its states for a query."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.model_selection import GroupKFold

from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._query import Query
from trajlearn.dynamics.baselines import CurveForecaster, MeanEpisodeForecaster, ReferenceForecaster
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import Columns

__all__ = ["BASE", "ahead", "curve", "fit_baseline", "relative_to"]

Floats = NDArray[np.float64]

# what the columns of references that hold the states of a baseline begin with
BASE = "baseline "
# a baseline that is learned is seen by the model as it will be at prediction: out of fold
_FOLDS = 5


def fit_baseline(
    baseline: Any,
    ds: TrajectoryDataset,
    weight: Floats | None,
    groups: NDArray[Any] | None,
    rng: np.random.Generator,
) -> tuple[Any, Floats | None]:
    """The fitted baseline, and its states for the training episodes (rows, d_s).

    A baseline that is learned predicts each training episode from the others (5 folds of whole
    groups): on its own training data it would be too good, and nothing be left to learn.

    Raises
    ------
    ValueError
        If there is but one group, or episodes have weights.
    """
    if baseline is None or (isinstance(baseline, str) and baseline == "state"):
        return None, None
    if isinstance(baseline, str):
        model: Any = MeanEpisodeForecaster()
    elif hasattr(baseline, "predict"):
        model = baseline
    else:
        model = ReferenceForecaster(baseline)
    if isinstance(model, FrozenEstimator):
        return model.estimator, curve(model.estimator, ds)
    model = seeded(model, rng)
    if isinstance(model, ReferenceForecaster):
        model.fit(ds)
        return model, curve(model, ds)
    if weight is not None:
        raise ValueError(
            "sample_weight together with a baseline that is learned is not exact: repeat the "
            "episodes, or give a fitted baseline, FrozenEstimator(model)."
        )
    groups = np.arange(len(ds)) if groups is None else groups
    n_groups = len(np.unique(groups))
    if n_groups < 2:
        raise ValueError(
            "a baseline that is learned needs episodes of at least two groups, to be seen on "
            "episodes that it was not fitted on. Log more, or use another baseline=."
        )
    states = np.empty_like(ds.states)
    rows = np.repeat(np.arange(len(ds)), ds.lengths + 1)
    for train, test in GroupKFold(min(_FOLDS, n_groups)).split(ds.lengths, groups=groups):
        fold = clone(model).fit(ds[train])
        states[np.isin(rows, test)] = curve(fold, ds[test])
    return model.fit(ds), states


def curve(model: Any, ds: TrajectoryDataset) -> Floats:
    """States of the baseline at all times of all episodes (rows, d_s).

    Of a model that forecasts from a start it is the forecast from the first state.
    """
    if isinstance(model, CurveForecaster):
        return model.curve(ds)
    forecast = model.predict(ds)
    _refuse_logged_actions(model, forecast)
    states = np.concatenate([ds.states[ds.offsets[:-1], None], forecast.mean], axis=1)
    return states[np.arange(states.shape[1]) <= ds.lengths[:, None]]


def ahead(model: Any, query: Query) -> Floats:
    """States of the baseline at each step of a query (n, H, d_s); zero in the padding."""
    n, n_steps = query.times.shape
    if isinstance(model, CurveForecaster):
        times = np.where(query.known(), query.times, query.initial_times[:, None])
        episode = np.repeat(np.arange(n), n_steps)
        states = model.at(query.ds, episode, times.ravel()).reshape(n, n_steps, -1)
    else:
        forecast = model.predict(query.ds, horizon=int((query.start + query.lengths).max()))
        _refuse_logged_actions(model, forecast)
        reach = query.start[:, None] + np.arange(n_steps)
        reach = np.minimum(reach, forecast.mean.shape[1] - 1)
        states = forecast.mean[np.arange(n)[:, None], reach]
    return np.where(query.known()[..., None], states, 0.0)


def relative_to(model: Any, ds: TrajectoryDataset, states: Floats) -> TrajectoryDataset:
    """The episodes with states relative to those of a baseline.

    A forecast from the first state is zero away from it, whatever that state is. So where the
    baseline is one, its states become references: inputs at t, at knots and at t + h.
    """
    if not np.isfinite(states).all():
        raise ValueError(
            f"the baseline {type(model).__name__} diverged, so nothing can be relative to it. "
            "Choose one that stays finite."
        )
    new: dict[str, Any] = {"states": ds.states - states}
    names = dict(ds._names)
    if not isinstance(model, CurveForecaster):
        given = [] if ds.references is None else [ds.references]
        new["references"] = np.concatenate([*given, states], axis=1)
        names["references"] += tuple(f"{BASE}{name}" for name in ds.state_names)
    return TrajectoryDataset._of(Columns(**(vars(ds._columns) | new)), names)


def _refuse_logged_actions(model: Any, forecast: Any) -> None:
    if forecast.actions == "logged":
        raise ValueError(
            f"baseline={type(model).__name__} replays logged actions, which a forecast does not "
            "know ahead. Give it a policy=, or use a baseline without actions."
        )
