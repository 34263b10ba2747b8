"""Predicting relative to a baseline: fitting it without leaks, and its states for a query."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._query import Query
from trajlearn.dynamics.baselines import (
    CurveForecaster,
    EpisodeForecaster,
    MeanEpisodeForecaster,
    ReferenceForecaster,
)
from trajlearn.dynamics.forecast import Forecast
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import Columns

__all__ = ["ahead", "curve", "fit_baseline", "relative_to"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

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
        If a learned baseline meets weights, or a context that is in one group only; if its
        states are not those of the episodes, or not finite.
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
        check_is_fitted(model.estimator)
        return model.estimator, _finite(model.estimator, curve(model.estimator, ds))
    model = seeded(model, rng)
    groups = np.arange(len(ds)) if groups is None else groups
    # what it holds out itself has to keep to the same groups
    ds = TrajectoryDataset._of(Columns(**(vars(ds._columns) | {"group": groups})), ds._names)
    if isinstance(model, EpisodeForecaster) and not model.learns:
        return model.fit(ds), _finite(model, curve(model, ds))
    if weight is not None:
        raise ValueError(
            "sample_weight together with a baseline that is learned is not exact: repeat the "
            "episodes, or give a fitted baseline, FrozenEstimator(model)."
        )
    states = np.empty_like(ds.states)
    rows = np.repeat(np.arange(len(ds)), ds.lengths + 1)
    for test in _folds(ds, groups, getattr(model, "by", None)):
        fold = clone(model).fit(ds[~test])
        states[test[rows]] = curve(fold, ds[test])
    return model.fit(ds), _finite(model, states)


def _folds(ds: TrajectoryDataset, groups: NDArray[Any], by: Any) -> list[NDArray[np.bool_]]:
    """Masks of the episodes held out in turn; the groups of a context are dealt out evenly."""
    names = ds.context if by is None else by
    labels = list(zip(*(ds.context[name].tolist() for name in names))) or [()] * len(ds)
    _, first, of_group = np.unique(groups, return_index=True, return_inverse=True)
    dealt: dict[Any, int] = {}
    fold = np.empty(len(first), dtype=np.intp)
    for group in np.argsort(first):
        label = labels[first[group]]
        fold[group] = dealt.get(label, 0) % _FOLDS
        dealt[label] = dealt.get(label, 0) + 1
    for label, count in dealt.items():
        if count < 2:
            where = f" with the context {dict(zip(names, label))}" if label else ""
            raise ValueError(
                "a baseline that is learned is seen on episodes that it was not fitted on, which "
                f"takes at least two groups{where}. Log more, name the context that matters "
                "(MeanEpisodeForecaster(by=...)), or use another baseline=."
            )
    return [fold[of_group] == number for number in range(fold.max() + 1)]


def curve(model: Any, ds: TrajectoryDataset) -> Floats:
    """States of the baseline at all times of all episodes (rows, d_s).

    Of a model that forecasts from a start it is the forecast from the first state.
    """
    if isinstance(model, CurveForecaster):
        return model.curve(ds)
    forecast = _forecast_of(model, ds)
    short = forecast.lengths < ds.lengths
    if short.any():
        i = int(np.argmax(short))
        raise ValueError(
            f"the baseline {type(model).__name__} forecasts {forecast.lengths[i]} of the "
            f"{ds.lengths[i]} steps of episode {ds.ids[i]} only (theta changes inside it?): cut "
            "the episodes there, or use another baseline=."
        )
    states = np.concatenate([ds.states[ds.offsets[:-1], None], forecast.mean], axis=1)
    return states[np.arange(states.shape[1]) <= ds.lengths[:, None]]


def ahead(model: Any, query: Query) -> Floats:
    """States of the baseline at each step of a query (n, H, d_s).

    Zero in the padding, infinite where the baseline has diverged.
    """
    n, n_steps = query.times.shape
    if isinstance(model, CurveForecaster):
        times = np.where(query.known(), query.times, query.initial_times[:, None])
        episode = np.repeat(np.arange(n), n_steps)
        states = model.at(query.ds, episode, times.ravel()).reshape(n, n_steps, -1)
    else:
        end = query.start + query.lengths
        if (end <= query.ds.lengths).all():
            # each to its own end: what follows is nobody's business
            columns = query.ds._columns.cut(np.arange(n), np.zeros(n, dtype=np.intp), end)
            forecast = _forecast_of(model, TrajectoryDataset._of(columns, query.ds._names))
        else:
            forecast = _forecast_of(model, query.ds, horizon=int(end.max()))
        reach = query.start[:, None] + np.arange(n_steps)
        reach = np.minimum(reach, forecast.mean.shape[1] - 1)
        states = forecast.mean[np.arange(n)[:, None], reach]
    states = np.where(np.isfinite(states), states, np.inf)
    return np.where(query.known()[..., None], states, 0.0)


def relative_to(ds: TrajectoryDataset, states: Floats, *, told: bool) -> TrajectoryDataset:
    """The episodes with states relative to those of a baseline.

    Parameters
    ----------
    ds : TrajectoryDataset
    states : ndarray of shape (rows, d_s)
        Of the baseline.
    told : bool
        Whether the states of the baseline become references, and so inputs: a deviation alone
        does not say where the plant is.
    """
    new: dict[str, Any] = {"states": ds.states - states}
    names = dict(ds._names)
    if told:
        given = [] if ds.references is None else [ds.references]
        new["references"] = np.concatenate([*given, states], axis=1)
        names["references"] += tuple(f"baseline {name}" for name in ds.state_names)
    return TrajectoryDataset._of(Columns(**(vars(ds._columns) | new)), names)


def _finite(model: Any, states: Floats) -> Floats:
    if not np.isfinite(states).all():
        raise ValueError(
            f"the baseline {type(model).__name__} diverged on training episodes, so nothing can "
            "be learned relative to it. Choose one that stays finite."
        )
    return states


def _forecast_of(model: Any, ds: TrajectoryDataset, **settings: Any) -> Forecast:
    """Forecast from the first states by a baseline, which has to be one of these states."""
    name = type(model).__name__
    if ds.hindsight:
        # for training targets it is what is wanted; a forecast has warned already
        ds = TrajectoryDataset._of(Columns(**(vars(ds._columns) | {"hindsight": False})), ds._names)
    forecast = model.predict(ds, **settings)
    if not isinstance(forecast, Forecast):
        raise TypeError(
            f"baseline={name} predicts {type(forecast).__name__}, not a Forecast: give a dynamics "
            "estimator, one of the forecasters, or a callable of the references."
        )
    if forecast.state_names != ds.state_names:
        raise ValueError(
            f"baseline={name} forecasts {list(forecast.state_names)}, the episodes have "
            f"{list(ds.state_names)}."
        )
    if forecast.actions == "logged":
        raise ValueError(
            f"baseline={name} replays logged actions, which a forecast does not know ahead. Give "
            "it a policy=, or use a baseline without actions."
        )
    return forecast
