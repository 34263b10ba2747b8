"""Forecasts that any model has to beat: hold, follow the reference, fly the mean episode."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from trajlearn._sklearn import fit_context
from trajlearn.dynamics._episodes_only import EpisodesOnly
from trajlearn.dynamics._forecaster import Prediction, Request
from trajlearn.dynamics._query import Query
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import MissingFieldError, NoUncertaintyError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._signals import interpolate
from trajlearn.trajectories.times import time_steps

__all__ = ["CurveForecaster", "HoldForecaster", "MeanEpisodeForecaster", "ReferenceForecaster"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class EpisodeForecaster(EpisodesOnly):
    """Forecaster of episodes by what all of them have in common, or by nothing."""

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {}

    @property
    def learns(self) -> bool:
        """Whether episodes other than the one that is forecast change the forecast."""
        return type(self)._learn is not EpisodeForecaster._learn

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: Any, y: None = None, *, groups: Any = None) -> Self:
        """Fit on episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Must be omitted.
        groups : array-like, optional
            Ignored.

        Returns
        -------
        self
        """
        ds = self._episodes(X, y)
        self._learn_ranges_of(ds)
        self._learn(ds)
        return self

    def predict(self, X: Any, return_std: bool = False, **settings: Any) -> Forecast:
        """Forecast episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        return_std : bool, default=False
            These forecasters have no standard deviation to give.
        **settings
            As in `forecast`.

        Returns
        -------
        Forecast
        """
        return self.forecast(X, return_std=return_std, **settings)

    def _learn(self, ds: TrajectoryDataset) -> None:
        """Learn from episodes; nothing by default."""

    def _refuse_uncertainty(self, request: Request) -> None:
        if request.return_std or request.n_samples:
            raise NoUncertaintyError(
                f"{type(self).__name__} gives no uncertainty: leave return_std= and n_samples= out."
            )


class HoldForecaster(EpisodeForecaster):
    """Nothing changes: the state at the start, at every horizon.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import HoldForecaster, TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays(np.arange(4.0).reshape(1, 4, 1))
    >>> HoldForecaster().fit(ds).predict(ds, start=1).mean[0, :, 0]
    array([1., 1.])
    """

    def _forecast(self, query: Query, request: Request) -> Prediction:
        self._refuse_uncertainty(request)
        return Prediction(np.repeat(query.initial_states[:, None], query.n_steps, axis=1))


class CurveForecaster(EpisodeForecaster):
    """Base of forecasters that say where an episode is at a time, whatever the start state.

    A subclass defines ``at(ds, episode, times)`` and, if it learns, ``_learn(ds)``.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import CurveForecaster, TrajectoryDataset
    >>> class Ramp(CurveForecaster):
    ...     def at(self, ds, episode, times):
    ...         return ds.params[episode] * times[:, None]
    >>> ds = TrajectoryDataset.from_arrays(np.zeros((1, 4, 1)), params=[[2.0]])
    >>> Ramp().fit(ds).predict(ds).mean[0, :, 0]
    array([2., 4., 6.])
    """

    @abstractmethod
    def at(self, ds: TrajectoryDataset, episode: Ints, times: Floats) -> Floats:
        """States at times of episodes.

        Parameters
        ----------
        ds : TrajectoryDataset
            What is known of the episodes: params, context, references, time origin.
        episode : ndarray of shape (m,)
            Number of the episode in `ds`.
        times : ndarray of shape (m,)
            Absolute.

        Returns
        -------
        ndarray of shape (m, d_s)
        """

    def curve(self, ds: TrajectoryDataset) -> Floats:
        """States at all logged times.

        Parameters
        ----------
        ds : TrajectoryDataset

        Returns
        -------
        ndarray of shape (sum of T + 1, d_s)
        """
        return self.at(ds, np.repeat(np.arange(len(ds)), ds.lengths + 1), ds.times)

    def _forecast(self, query: Query, request: Request) -> Prediction:
        self._refuse_uncertainty(request)
        n, n_steps = query.times.shape
        times = np.where(query.known(), query.times, query.initial_times[:, None])
        states = self.at(query.ds, np.repeat(np.arange(n), n_steps), times.ravel())
        return Prediction(states.reshape(n, n_steps, -1))


class ReferenceForecaster(CurveForecaster):
    """The plant follows its reference perfectly.

    Parameters
    ----------
    state_of : callable
        ``state_of(references (m, d_r)) -> (m, d_s)``: the state that belongs to a reference;
        zero (or what holds at rest) where the reference says nothing.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import ReferenceForecaster, TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays(np.zeros((1, 4, 1)), references=np.ones((1, 4, 1)))
    >>> ReferenceForecaster(lambda references: references).fit(ds).predict(ds).mean[0, :, 0]
    array([1., 1., 1.])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {"state_of": [callable]}

    def __init__(self, state_of: Callable[[Floats], Any]) -> None:
        self.state_of = state_of

    @property
    def learns(self) -> bool:
        """The reference of an episode is its own."""
        return False

    def _learn(self, ds: TrajectoryDataset) -> None:
        # its only duty is to fail early
        self.at(ds[:1], np.zeros(1, dtype=np.intp), ds.times[:1])

    def _reads_logged_future(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        return True

    def at(self, ds: TrajectoryDataset, episode: Ints, times: Floats) -> Floats:
        """States of the references, which are linear between samples.

        Parameters
        ----------
        ds, episode, times
            As in `CurveForecaster.at`.

        Returns
        -------
        ndarray of shape (m, d_s)

        Raises
        ------
        MissingFieldError
            If the episodes have no references.
        """
        ds.require("references", by=type(self).__name__)
        assert ds.references is not None  # just checked
        first, last = ds.offsets[:-1][episode], ds.offsets[1:][episode] - 1
        references = interpolate(ds.times, ds.references, first, last, times)
        states = np.asarray(self.state_of(references), dtype=np.float64)
        if states.shape != (len(times), len(self.state_names_)):
            name = getattr(self.state_of, "__name__", type(self.state_of).__name__)
            raise ValueError(
                f"{name} returned shape {states.shape} for references of shape "
                f"{references.shape}; expected {(len(times), len(self.state_names_))}, a state "
                f"({', '.join(self.state_names_)}) for each row."
            )
        return states


class MeanEpisodeForecaster(CurveForecaster):
    """The mean of the training episodes at the same phase, in the same context.

    The phase is the time since `time_origin`; where no episode has one, since the first sample.
    Outside of what was logged the nearest mean is held.

    Parameters
    ----------
    by : sequence of str or None, default=None
        Names of the context that parts episodes into groups; None takes all there are.

    Attributes
    ----------
    groups_ : list of tuple
        Values of the context of each group.
    phases_ : list of ndarray of shape (n_phases,)
    means_ : list of ndarray of shape (n_phases, d_s)
    counts_ : list of ndarray of shape (n_phases,)
        Episodes behind each mean.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import MeanEpisodeForecaster, TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays([[[0.0], [1.0], [2.0]], [[0.0], [3.0]]])
    >>> model = MeanEpisodeForecaster().fit(ds)
    >>> model.predict(ds[:1]).mean[0, :, 0], model.state_at(0.5)
    (array([2., 2.]), array([1.]))
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {"by": ["array-like", None]}

    def __init__(self, *, by: Sequence[str] | None = None) -> None:
        self.by = by

    def _learn(self, ds: TrajectoryDataset) -> None:
        self.by_ = tuple(ds.context if self.by is None else self.by)
        if unknown := [name for name in self.by_ if name not in ds.context]:
            raise MissingFieldError(
                f"by= names {unknown}, the context of the episodes has {list(ds.context)}."
            )
        self.has_origin_ = bool(np.isfinite(ds.time_origin).any())
        step = float(np.median(time_steps(ds)))
        labels = self._labels(ds)
        self.groups_ = sorted(set(labels))
        self.phases_: list[Floats] = []
        self.means_: list[Floats] = []
        self.counts_: list[Ints] = []
        for group in self.groups_:
            own = ds[[label == group for label in labels]]
            phase = own.times - np.repeat(self._origin(own), own.lengths + 1)
            grid = step * np.arange(np.floor(phase.min() / step), np.ceil(phase.max() / step) + 1)
            total, count = np.zeros((len(grid), own.states.shape[1])), np.zeros(len(grid))
            for first, last in zip(own.offsets[:-1], own.offsets[1:] - 1):
                # half a step beyond its ends an episode still counts, so that no phase is empty
                reach = (grid >= phase[first] - step / 2) & (grid <= phase[last] + step / 2)
                n = int(reach.sum())
                ends = np.full(n, first), np.full(n, last)
                total[reach] += interpolate(phase, own.states, *ends, grid[reach])
                count += reach
            self.phases_.append(grid[count > 0])
            self.means_.append(total[count > 0] / count[count > 0, None])
            self.counts_.append(count[count > 0].astype(np.intp))

    def at(self, ds: TrajectoryDataset, episode: Ints, times: Floats) -> Floats:
        """Mean states at the phases of the times.

        Parameters
        ----------
        ds, episode, times
            As in `CurveForecaster.at`.

        Returns
        -------
        ndarray of shape (m, d_s)

        Raises
        ------
        MissingFieldError
            If an episode has no `time_origin`, but training episodes had.
        ValueError
            If an episode has a context that no training episode had.
        """
        phase = times - self._origin(ds)[episode]
        states = np.empty((len(times), len(self.state_names_)))
        labels = self._labels(ds)
        of_episode = np.array([self._group_of(label) for label in labels], dtype=np.intp)
        group = of_episode[episode]
        for i in np.unique(group):
            mine = group == i
            states[mine] = self._mean_at(i, phase[mine])
        return states

    def _mean_at(self, group: int, phase: Floats) -> Floats:
        first = np.zeros(len(phase), dtype=np.intp)
        last = np.full(len(phase), len(self.phases_[group]) - 1)
        return interpolate(self.phases_[group], self.means_[group], first, last, phase)

    def state_at(self, phase: float, context: Mapping[str, Any] | None = None) -> Floats:
        """Mean state at a phase: a nominal start.

        Parameters
        ----------
        phase : float
        context : mapping from name to value, optional
            Needed for the names in `by`.

        Returns
        -------
        ndarray of shape (d_s,)
        """
        given = context or {}
        if missing := [name for name in self.by_ if name not in given]:
            raise MissingFieldError(f"context= lacks {missing}.")
        i = self._group_of(tuple(given[name] for name in self.by_))
        return self._mean_at(i, np.array([float(phase)]))[0]

    def _labels(self, ds: TrajectoryDataset) -> list[tuple[Any, ...]]:
        context = ds.context
        if missing := [name for name in self.by_ if name not in context]:
            raise MissingFieldError(f"the episodes have no context {missing}, which fit saw.")
        return list(zip(*(context[name].tolist() for name in self.by_))) or [()] * len(ds)

    def _group_of(self, label: tuple[Any, ...]) -> int:
        if label not in self.groups_:
            raise ValueError(
                f"no training episode has the context {dict(zip(self.by_, label))}; fit saw "
                f"{[dict(zip(self.by_, group)) for group in self.groups_]}."
            )
        return self.groups_.index(label)

    def _origin(self, ds: TrajectoryDataset) -> Floats:
        """Time at which the phase of each episode is zero."""
        origin = ds.time_origin
        if not self.has_origin_:
            return np.where(np.isfinite(origin), origin, ds.times[ds.offsets[:-1]])
        if np.isnan(origin).any():
            raise MissingFieldError(
                f"episode {ds.ids[np.isnan(origin)][0]} has no time_origin, so its phase is "
                "unknown. Give it, or leave such episodes out."
            )
        return origin
