"""Forecasting from episodes: queries, divergence, scores, rewards."""

import warnings
from abc import abstractmethod
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._query import Query, make_query
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import DivergenceWarning, HorizonWarning, SmoothingWarning
from trajlearn.trajectories import TrajectoryDataset, as_dataset
from trajlearn.trajectories._relabeler import generator
from trajlearn.trajectories.rewards import Reward, step_rewards

__all__ = ["DIVERGENCE_RANGES", "Forecaster", "Prediction", "Request", "check_n_samples"]

Floats = NDArray[np.float64]

# a forecast further than this from the training states, in their ranges, counts as diverged
DIVERGENCE_RANGES = 1e6


@dataclass
class Prediction:
    """What a formulation computes for a `Query`: arrays (n, H, d_s), samples one axis more."""

    mean: Floats
    std: Floats | None = None
    samples: Floats | None = None
    actions: str = "none"


@dataclass(frozen=True)
class Request:
    """How a query is to be answered: the arguments of `forecast` that say so."""

    actions: str
    policy: Any
    return_std: bool
    n_samples: int | None
    rng: np.random.Generator

    def __post_init__(self) -> None:
        check_n_samples(self.n_samples)


def check_n_samples(n_samples: Any) -> None:
    """Raise an error for what is no number of trajectories."""
    counts = isinstance(n_samples, Integral) and not isinstance(n_samples, bool)
    if n_samples is not None and not (counts and n_samples >= 0):
        raise ValueError(
            f"n_samples = {n_samples!r}: give the number of trajectories to draw, such as 100, or "
            "None to draw none."
        )


class Forecaster(BaseEstimator):
    """Anything that predicts future states from the past of an episode."""

    state_range_: Floats
    state_names_: tuple[str, ...]
    max_horizon_: float
    error_score: float = -1e12

    _needs_constant_params = False

    @abstractmethod
    def _forecast(self, query: Query, request: Request) -> Prediction:
        """Predict the states of a query."""

    def _reads_logged_future(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        """Whether a forecast needs logged signals after the start."""
        return False

    def _ends_with_log(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        """Whether a forecast ends with the log, because nobody knows what it needs beyond."""
        return self._reads_logged_future(ds, actions, policy)

    def _learn_ranges(self, states: Floats, names: tuple[str, ...], longest: float) -> None:
        self.state_range_ = np.stack([states.min(axis=0), states.max(axis=0)])
        self.state_names_ = names
        self.max_horizon_ = longest

    def _learn_ranges_of(self, ds: TrajectoryDataset) -> None:
        """Ranges of what was measured: errors behind a smoother and without it are comparable."""
        self._learn_ranges(ds.states, ds.state_names, np.inf)
        if ds.observed is not None:
            for i, name in enumerate(ds.state_names):
                if name in ds.observed_names:
                    measured = ds.observed[:, ds.observed_names.index(name)]
                    self.state_range_[:, i] = measured.min(), measured.max()

    def forecast(
        self,
        X: Any,
        *,
        start: ArrayLike = 0,
        horizon: int | None = None,
        actions: str = "auto",
        policy: Any = None,
        return_std: bool = False,
        n_samples: int | None = None,
        random_state: Any = None,
    ) -> Forecast:
        """Predict the states after a start.

        History is ``states[:start + 1]`` and ``actions[:start]``. Nothing later is read except
        times, references, theta and, only with ``actions="logged"``, actions.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        start : int, array-like of shape (n,) or (n, k), or list of n arrays, default=0
            Index of the state to begin at: one, one per episode, or several per episode, as many
            in each or not.
        horizon : int or None, default=None
            Steps to predict; None goes to the end of each episode. With known times ahead a
            forecast may go past the log; one that needs logged signals there, such as references,
            ends with it.
        actions : {"auto", "logged", "policy"}, default="auto"
            Where a roll-out takes its actions from; models without actions ignore it.
        policy : callable, optional
            ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``.
        return_std : bool, default=False
            Also predict the total predictive standard deviation.
        n_samples : int or None, default=None
            Also draw that many whole trajectories.
        random_state : int, RandomState or None, default=None

        Returns
        -------
        Forecast

        Warns
        -----
        SmoothingWarning
            If a smoother has estimated the states from what follows them, too (`hindsight`).
        HorizonWarning
            If a horizon is longer than any in training.
        DivergenceWarning
            If a forecast becomes non-finite or leaves 1e6 training ranges.
        """
        check_is_fitted(self, "state_range_")
        ds = self._checked(as_dataset(X))
        if actions not in ("auto", "logged", "policy"):
            raise ValueError(f'actions = {actions!r}; choose "auto", "logged" or "policy".')
        query, episode = make_query(
            ds,
            start,
            horizon,
            within_log=self._ends_with_log(ds, actions, policy),
            within_stretch=self._needs_constant_params,
        )
        self._warn_hindsight(ds)
        self._warn_beyond_training(query)
        rng = np.random.default_rng() if random_state is None else generator(random_state)
        request = Request(actions, policy, return_std, n_samples, rng)
        prediction = self._forecast(query, request)
        return self._as_forecast(query, prediction, episode)

    def _score_episodes(self, X: Any, sample_weight: Any) -> float:
        """Minus the range-normalised squared error from the first state on."""
        ds = as_dataset(X)
        squared = self.forecast(ds).squared_errors(ds)
        asked = ~np.isnan(squared)
        per_episode = -np.where(asked, squared, 0).sum(axis=(1, 2)) / asked.sum(axis=(1, 2))
        per_episode = np.maximum(per_episode, self.error_score)
        return float(np.average(per_episode, weights=sample_weight))

    def predict_reward(
        self,
        X: Any,
        reward: Reward | None = None,
        *,
        horizon: int | None = None,
        return_std: bool = False,
        n_samples: int = 100,
        random_state: Any = None,
        **settings: Any,
    ) -> Any:
        """Predict the mean reward per step of each episode.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        reward : callable
            ``reward(states)`` of the predicted states (n, H, d_s); it may also name
            `references` and `times`, and `actions` where they are logged.
        horizon : int or None, default=None
            Steps from the first state; None takes each episode's own length.
        return_std : bool, default=False
            Also return the standard deviation over `n_samples` whole trajectories.
        n_samples : int, default=100
        random_state : int, RandomState or None
        **settings
            Further arguments of `forecast`.

        Returns
        -------
        mean : ndarray of shape (n,)
            Reward of the mean trajectory, which for a curved reward is not the mean reward of the
            samples; -inf where the forecast diverged.
        std : ndarray of shape (n,), if asked for
            Of the rewards of the samples; inf where some trajectory diverged.
        """
        if reward is None:
            raise ValueError(
                "give reward=: a function of states; logged rewards are not predicted by a model "
                "of the states (DirectRewardGP learns them)."
            )
        ds = as_dataset(X)
        forecast = self.forecast(
            ds,
            horizon=horizon,
            n_samples=n_samples if return_std else None,
            random_state=random_state,
            **settings,
        )
        of = ds if forecast.episode is None else ds[forecast.episode]
        query = Query(of, forecast.start, forecast.lengths, forecast.times)
        # like the states, times are finite in the padding
        times = np.where(query.known(), query.times, query.initial_times[:, None])
        signals: dict[str, Any] = {"times": times}
        if of.references is not None:
            signals["references"] = query.future(of.references, steps=False)[:, 1:]
        if of.actions is not None and forecast.actions == "logged":
            signals["actions"] = query.future(of.actions, steps=True)
        mean = _mean_reward(reward, forecast.mean, forecast.lengths, signals)
        if not return_std:
            return mean
        assert forecast.samples is not None  # asked for above
        drawn = [_mean_reward(reward, path, forecast.lengths, signals) for path in forecast.samples]
        with np.errstate(invalid="ignore"):
            spread = np.std(drawn, axis=0)
        return mean, np.where(np.isinf(drawn).any(axis=0), np.inf, spread)

    # -- checks and results ---------------------------------------------------------------

    def _checked(self, ds: TrajectoryDataset) -> TrajectoryDataset:
        d_s = self.state_range_.shape[1]
        if ds.states.shape[1] != d_s:
            raise ValueError(
                f"the episodes have {ds.states.shape[1]} states ({', '.join(ds.state_names)}), the "
                f"model was fitted on {d_s} ({', '.join(self.state_names_)})."
            )
        return ds

    def _warn_hindsight(self, ds: TrajectoryDataset) -> None:
        if ds.hindsight:
            warnings.warn(
                "states estimated from whole episodes, so that a start has seen what follows; use "
                "the smoother in a Pipeline, or transform().",
                SmoothingWarning,
                stacklevel=4,
            )

    def _warn_beyond_training(self, query: Query) -> None:
        longest = np.nanmax(query.horizons)
        if longest > self.max_horizon_ * (1 + 1e-6):
            warnings.warn(
                f"a forecast reaches {longest:g} ahead, the longest horizon in training was "
                f"{self.max_horizon_:g}: what follows is extrapolation.",
                HorizonWarning,
                stacklevel=4,
            )

    def _as_forecast(
        self, query: Query, prediction: Prediction, episode: NDArray[np.intp] | None
    ) -> Forecast:
        diverged_at = self._mark(prediction, query.known())
        if diverged_at.any():
            n_diverged = int((diverged_at > 0).sum())
            warnings.warn(
                f"{n_diverged} of {len(query)} forecasts diverged (first at step "
                f"{diverged_at[diverged_at > 0].min()}): their states are inf from there on. "
                "A one-step model of an unstable plant does this when it replays logged actions; "
                "try actions='policy', clip_states=, or TrajectoryRegressor.",
                DivergenceWarning,
                stacklevel=4,
            )
        return Forecast(
            prediction.mean,
            times=query.times,
            horizons=np.arange(1, query.n_steps + 1),
            lengths=query.lengths,
            initial_states=query.initial_states,
            initial_times=query.initial_times,
            start=query.start,
            diverged_at=diverged_at,
            state_range=self.state_range_,
            state_names=self.state_names_,
            actions=prediction.actions,
            std=prediction.std,
            samples=prediction.samples,
            episode=episode,
        )

    def _mark(self, prediction: Prediction, known: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Set padding to NaN and everything from a divergence on to inf; return where it begins."""
        low, high = self.state_range_
        limit = DIVERGENCE_RANGES * np.where(high > low, high - low, 1.0)
        with np.errstate(invalid="ignore"):
            off = np.abs(prediction.mean - (low + high) / 2) > limit
        gone = (off | ~np.isfinite(prediction.mean)).any(axis=2) & known
        gone = np.logical_or.accumulate(gone, axis=1)
        for values in (prediction.mean, prediction.std, prediction.samples):
            if values is not None:
                values[..., gone, :] = np.inf
                values[..., ~known, :] = np.nan
        return np.where(gone.any(axis=1), gone.argmax(axis=1) + 1, 0)


def _mean_reward(
    reward: Reward, states: Floats, lengths: NDArray[np.intp], signals: dict[str, Any]
) -> Floats:
    """Mean over the predicted steps; -inf for a diverged forecast."""
    asked = np.arange(states.shape[1]) < lengths[:, None]
    diverged = np.isinf(states).any(axis=2)
    finite = np.where((asked & ~diverged)[..., None], states, 0.0)
    values = step_rewards(reward, finite, **signals)
    values = np.where(diverged & asked, -np.inf, np.where(asked, values, 0.0))
    return values.sum(axis=1) / lengths
