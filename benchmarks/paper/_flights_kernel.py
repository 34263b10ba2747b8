"""Predictions of flights by kernel ridge regression from the gains, and linear corrections."""

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn import config_context
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, MaxAbsScaler, StandardScaler

from benchmarks.paper._flights_data import HORIZONS, starts, truth_at
from trajlearn import MeanEpisodeForecaster, TrajectoryDataset

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

LENGTHS = (2.0, 4.0, 8.0, 16.0)
RIDGES = (0.01, 0.1, 1.0, 10.0, 100.0, 1e4)
LINEAR_RIDGES = [(1.0,), (1e2,), (1e3,), (1e4,), (1e6,)]
_FOLDS = 5


def log_offset(values: Floats) -> Floats:
    """Logarithm of values whose greatest is 1; gains of the integrators may be 0."""
    return np.log(values + 0.02)


def bounded(values: Floats) -> Floats:
    """Standardised values, those of settings far from all others cut off."""
    return np.clip(values, -4.0, 4.0)


def gain_scaler() -> Any:
    """Gains on a logarithmic scale, standardised."""
    return make_pipeline(
        MaxAbsScaler(),
        FunctionTransformer(log_offset),
        StandardScaler(),
        FunctionTransformer(bounded),
    )


class GainsCurveForecaster(MeanEpisodeForecaster):
    """The mean flight of that kind, and what kernel ridge regression adds from the gains.

    For each kind of flight and each state, the deviation of the whole flight from the mean one
    at the same phase. Flights of which the beginning is not logged count where they are: every
    stretch of phases is fitted on the flights that cover it. Length scale and ridge of each
    state are chosen by cross-validation over experiments inside the training flights.
    """

    def _learn(self, ds: TrajectoryDataset) -> None:
        super()._learn(ds)
        self.deviations_ = []
        numbers = self.group_numbers(ds)
        # hundreds of tiny fits, whose time is mostly that of checks
        with config_context(assume_finite=True, skip_parameter_validation=True):
            for i in range(len(self.groups_)):
                own = _Deviation(ds[numbers == i], self.phases_[i], self.means_[i])
                self.deviations_.append(own)

    def at(self, ds: TrajectoryDataset, episode: Ints, times: Floats) -> Floats:
        """Mean flight and deviation at times of flights."""
        states = super().at(ds, episode, times)
        phase = times - ds.time_origin[episode]
        of_flight = self.group_numbers(ds)
        for i, deviation in enumerate(self.deviations_):
            mine = np.flatnonzero(of_flight[episode] == i)
            if len(mine):
                states[mine] += deviation.at(ds.params[episode[mine]], phase[mine])
        return states

    def group_numbers(self, ds: TrajectoryDataset) -> Ints:
        """Which of `groups_` each flight belongs to."""
        return np.array([self._group_of(label) for label in self._labels(ds)], dtype=np.intp)


class _Deviation:
    """Deviation of the flights of one kind from their mean, from gains and phase."""

    def __init__(self, ds: TrajectoryDataset, grid: Floats, mean: Floats) -> None:
        self.grid = grid
        self.scaler = gain_scaler().fit(ds.params)
        gains, n_states = self.scaler.transform(ds.params), mean.shape[1]
        values = np.full((len(ds), len(grid), n_states), np.nan)
        for i, (low, high) in enumerate(zip(ds.offsets[:-1], ds.offsets[1:], strict=True)):
            phase = ds.times[low:high] - ds.time_origin[i]
            # half a step beyond its ends a flight still counts, as in the mean
            half = (grid[1] - grid[0]) / 2
            there = (grid >= phase[0] - half) & (grid <= phase[-1] + half)
            for j in range(n_states):
                values[i, there, j] = np.interp(grid[there], phase, ds.states[low:high, j])
        values -= mean
        self.chosen = _choose(gains, values, ds.group)
        covered = ~np.isnan(values[..., 0])
        edges = np.flatnonzero((covered[:, 1:] != covered[:, :-1]).any(axis=0)) + 1
        self.parts: list[tuple[slice, Any, Any]] = []
        for low, high in zip(np.r_[0, edges], np.r_[edges, len(grid)], strict=True):
            there = covered[:, low]
            for setting in sorted(set(self.chosen)):
                states = [j for j, own in enumerate(self.chosen) if own == setting]
                some = values[there][:, low:high][..., states]
                model = _ridge(*setting).fit(gains[there], some.reshape(len(some), -1))
                self.parts.append((slice(low, high), states, model))

    def at(self, params: Floats, phase: Floats) -> Floats:
        """Deviations (m, d_s) at gains (m, p) and phases (m,)."""
        unique, which = np.unique(params, axis=0, return_inverse=True)
        gains = self.scaler.transform(unique)
        curves = np.zeros((len(unique), len(self.grid), len(self.chosen)))
        for where, states, model in self.parts:
            shape = (len(unique), where.stop - where.start, len(states))
            curves[:, where, states] = model.predict(gains).reshape(shape)
        # between two phases linear, beyond the ends held
        place = np.interp(phase, self.grid, np.arange(len(self.grid)))
        low = np.minimum(place.astype(np.intp), max(len(self.grid) - 2, 0))
        high = np.minimum(low + 1, len(self.grid) - 1)
        part, which = (place - low)[:, None], which.reshape(-1)
        return (1 - part) * curves[which, low] + part * curves[which, high]


def _ridge(length: float, alpha: float) -> KernelRidge:
    return KernelRidge(kernel="rbf", gamma=0.5 / length**2, alpha=alpha)


def _choose(gains: Floats, values: Floats, group: Any) -> list[tuple[float, float]]:
    """Length and ridge of each state, by the phases that all flights cover."""
    common = values[:, ~np.isnan(values).any(axis=(0, 2))][:, ::5]
    settings = [(length, alpha) for length in LENGTHS for alpha in RIDGES]
    return best_by_state(_ridge, settings, gains, common, group)


def best_by_state(
    make: Callable[..., Any], settings: list[Any], rows: Floats, targets: Floats, group: Any
) -> list[Any]:
    """Setting with the least error of each state (the last axis) on experiments held out."""
    n_states, n_groups = targets.shape[-1], len(np.unique(group))
    if n_groups < 2 or not targets.size:
        return settings[-1:] * n_states
    flat = targets.reshape(len(targets), -1)
    errors = np.zeros((len(settings), n_states))
    for train, test in GroupKFold(min(_FOLDS, n_groups)).split(rows, groups=group):
        for error, setting in zip(errors, settings, strict=True):
            off = make(*setting).fit(rows[train], flat[train]).predict(rows[test]) - flat[test]
            error += (off.reshape(-1, n_states) ** 2).sum(axis=0)
    return [settings[best] for best in errors.argmin(axis=0)]


def out_of_fold(model: Any, ds: TrajectoryDataset) -> Floats:
    """Curve (rows, d_s) of each training flight, predicted from those of other experiments."""
    states = np.empty_like(ds.states)
    rows = np.repeat(np.arange(len(ds)), ds.lengths + 1)
    for train, test in GroupKFold(_FOLDS).split(ds.lengths, groups=ds.group):
        states[np.isin(rows, test)] = clone(model).fit(ds[train]).curve(ds[test])
    return states


def linear_forecast(
    train: TrajectoryDataset, test: TrajectoryDataset, curves: GainsCurveForecaster
) -> Floats:
    """States (n, n_horizons, d_s): the curve, and a ridge regression on how far off it is now.

    One for each kind of flight, horizon and state; its strength is chosen by cross-validation
    over experiments. The training flights are seen with curves of models that do not know them.
    """
    inner = _off_curve(train, out_of_fold(GainsCurveForecaster(), train))
    outer = _off_curve(test, curves.curve(test))
    labels = (
        curves.group_numbers(ds)[some.episode] for ds, some in ((train, inner), (test, outer))
    )
    trained, asked = labels
    result = outer.then.copy()
    for i, k in product(range(len(curves.groups_)), range(len(HORIZONS))):
        mine = (trained == i) & np.isfinite(inner.then[:, k, 0])
        reach = (asked == i) & np.isfinite(outer.then[:, k, 0])
        if not mine.any() or not reach.any():
            continue
        rows, targets = inner.now[mine], inner.truth[mine, k] - inner.then[mine, k]
        group = train.group[inner.episode[mine]]
        chosen = best_by_state(_linear, LINEAR_RIDGES, rows, targets, group)
        for setting in sorted(set(chosen)):
            states = [j for j, own in enumerate(chosen) if own == setting]
            model = _linear(*setting).fit(rows, targets[:, states])
            step = model.predict(outer.now[reach]).reshape(reach.sum(), 1, len(states))
            result[np.ix_(reach, [k], states)] += step
    return result


def _linear(alpha: float) -> Any:
    return make_pipeline(StandardScaler(), Ridge(alpha))


class _OffCurve(NamedTuple):
    """Of each start: its flight, distance from the curve, curve and truth at the horizons."""

    episode: Ints
    now: Floats
    then: Floats
    truth: Floats


def _off_curve(ds: TrajectoryDataset, curve: Floats) -> _OffCurve:
    at = truth_at(ds)
    now = np.concatenate([ds.offsets[i] + some for i, some in enumerate(starts(ds))])
    last = ds.offsets[1:][at.episode] - 1
    rows = np.minimum(now[:, None] + np.array(HORIZONS), last[:, None])
    then = np.where(np.isnan(at.truth), np.nan, curve[rows])
    return _OffCurve(at.episode, ds.states[now] - curve[now], then, at.truth)
