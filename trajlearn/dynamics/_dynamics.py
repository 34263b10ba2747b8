"""What every formulation offers: rows or episodes, a baseline, forecasts for planning."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._base import TwoDoorRegressor
from trajlearn.dynamics._forecaster import Forecaster, Prediction, Request
from trajlearn.dynamics._planned import broadcast, by_episode, planned
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._relative import ahead, curve, fit_baseline, relative_to
from trajlearn.dynamics.baselines import CurveForecaster
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories import TrajectoryDataset, is_episodes

__all__ = ["DynamicsEstimator"]

Floats = NDArray[np.float64]


class DynamicsEstimator(Forecaster, TwoDoorRegressor):
    """Estimator of future states from logged episodes."""

    baseline: Any
    baseline_: Any

    # whether it predicts on a grid of the training steps only
    _rolls_out = False

    # -- what a formulation defines -------------------------------------------------------

    @abstractmethod
    def _fit_states(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        """Fit on episodes whose states are relative to the baseline, if there is one."""

    @abstractmethod
    def _forecast_states(self, query: Query, request: Request) -> Prediction:
        """Predict the states of a query, relative to the baseline."""

    # -- fitting --------------------------------------------------------------------------

    def _fit_door_of_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> None:
        if not (
            self.baseline is None or (isinstance(self.baseline, str) and self.baseline == "state")
        ):
            raise ValueError(
                f"baseline={self.baseline!r} needs episodes: rows say neither which episode they "
                "are from nor when. Fit on episodes, or leave baseline= out."
            )
        self.baseline_, self.n_references_ = None, 0
        super()._fit_door_of_rows(X, y, sample_weight, groups)

    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        # a model of one step knows no longest horizon; the others set it
        self._learn_ranges_of(ds)
        self.n_references_ = len(ds.reference_names)
        self.baseline_, states = fit_baseline(self.baseline, ds, weight, groups, self._rng)
        if states is not None:
            ds = relative_to(ds, states, told=self._told())
        self._fit_states(ds, weight, groups)

    def _told(self) -> bool:
        """Whether the states of the baseline are inputs."""
        return not isinstance(self.baseline_, CurveForecaster)

    # -- prediction -----------------------------------------------------------------------

    def _forecast(self, query: Query, request: Request) -> Prediction:
        base = None
        if self.baseline_ is not None:
            states = curve(self.baseline_, query.ds)
            # from where it diverged nothing is asked for, or the answer is infinite
            states = np.where(np.isfinite(states), states, 0.0)
            base = ahead(self.baseline_, query)
            start = states[query.rows][:, None]
            query = replace(
                query,
                ds=relative_to(query.ds, states, told=self._told()),
                base=np.concatenate([start, np.where(np.isfinite(base), base, 0.0)], axis=1),
            )
        prediction = self._forecast_states(query, request)
        if base is not None:
            prediction.mean = prediction.mean + base
            if prediction.samples is not None:
                prediction.samples = prediction.samples + base
        return prediction

    def _ends_with_log(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        own = self._reads_logged_future(ds, actions, policy)
        base = self.baseline_
        return own or (isinstance(base, Forecaster) and base._ends_with_log(ds, "auto", None))

    def _predict_rows(self, X: Any, return_std: bool) -> Any:
        if getattr(self, "baseline_", None) is not None:
            raise ValueError(
                "rows do not say which episode they are from, so nothing can be predicted relative "
                f"to baseline={self.baseline!r}: predict episodes."
            )
        return super()._predict_rows(X, return_std)

    def predict(
        self,
        X: Any,
        return_std: bool = False,
        *,
        start: ArrayLike = 0,
        horizon: int | None = None,
        actions: str = "auto",
        policy: Any = None,
        n_samples: int | None = None,
        random_state: Any = None,
    ) -> Any:
        """Predict rows, or forecast episodes.

        Parameters
        ----------
        X : array-like of shape (n, n_features), TrajectoryDataset or list of Trajectory
        return_std : bool, default=False
        start, horizon, actions, policy, n_samples, random_state
            As in `forecast`; for episodes only.

        Returns
        -------
        ndarray of shape (n,) or (n, d_s), with a second one if `return_std`; or Forecast
        """
        settings: dict[str, Any] = {
            "start": start,
            "horizon": horizon,
            "actions": actions,
            "policy": policy,
            "n_samples": n_samples,
            "random_state": random_state,
        }
        if is_episodes(X):
            return self.forecast(X, return_std=return_std, **settings)
        default: dict[str, Any] = {"start": 0, "actions": "auto"}
        odd = [key for key, value in settings.items() if value is not default.get(key)]
        if odd:
            raise TypeError(f"{odd} are for episodes; rows are predicted one by one.")
        return self._predict_rows(X, return_std)

    def score(self, X: Any, y: ArrayLike | None = None, sample_weight: Any = None) -> float:
        """R^2 on rows; on episodes, minus the range-normalised squared error.

        On episodes the error is averaged over states, over the horizon from the first state to
        the end of each episode, and over episodes; a diverged episode counts `error_score`.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
            For rows only.
        sample_weight : array-like of shape (n,), optional

        Returns
        -------
        float
            Greater is better.
        """
        if not is_episodes(X):
            return float(super().score(X, y, sample_weight))
        if y is not None:
            raise ValueError("y must be omitted with episodes.")
        return self._score_episodes(X, sample_weight)

    def predict_trajectory(
        self,
        initial_states: ArrayLike,
        *,
        horizons: ArrayLike,
        params: ArrayLike | None = None,
        actions: ArrayLike | None = None,
        policy: Any = None,
        references: ArrayLike | Callable[[Floats], ArrayLike] | None = None,
        context: Mapping[str, Any] | None = None,
        phase: ArrayLike | None = None,
        return_std: bool = False,
        n_samples: int | None = None,
        random_state: Any = None,
    ) -> Forecast:
        """Predict from states and known signals alone, without a dataset: for planning.

        Parameters
        ----------
        initial_states : array-like of shape (n, d_s) or (d_s,)
            One state with n rows of `params` is meant for all of them.
        horizons : array-like of shape (H,)
            Times after the start, increasing and positive, in the unit of `times`.
        params : array-like of shape (n, p) or (p,), optional
        actions : array-like of shape (n, n_steps, d_a) or (n_steps, d_a), optional
            One an underlying time step, for one-step models.
        policy : callable, optional
        references : array-like or callable, optional
            Shape (n, n_steps + 1, d_r) or (n_steps + 1, d_r): at the start and at each underlying
            step (each horizon, for trajectory models), linear in between. A callable
            ``references(times (n_t,)) -> (n_t, d_r)``, of times after the start, is asked
            wherever the model looks.
        context : mapping from name to a value or n values, optional
        phase : float or array-like of shape (n,), optional
            Time since `time_origin` at the start.
        return_std, n_samples, random_state
            As in `forecast`.

        Returns
        -------
        Forecast
            Its `horizons` are those given.

        Raises
        ------
        MissingFieldError
            If the model was fitted with a known signal, context or phase that is not given.
        """
        check_is_fitted(self, "estimator_")
        states = np.atleast_2d(np.asarray(initial_states, dtype=np.float64))
        if states.ndim != 2 or states.shape[1] != self.state_range_.shape[1]:
            raise ValueError(
                f"initial_states has shape {np.shape(initial_states)}; expected (n, "
                f"{self.state_range_.shape[1]})."
            )
        if not np.isfinite(states).all():
            raise ValueError("initial_states has NaN or infinite values.")
        wanted = np.atleast_1d(np.asarray(horizons, dtype=np.float64))
        if wanted.ndim != 1 or not len(wanted) or wanted[0] <= 0 or (np.diff(wanted) <= 0).any():
            raise ValueError("horizons must be positive and strictly increasing times.")
        grid, chosen = self.planning_grid(wanted, references=callable(references))
        if callable(references):
            references = np.asarray(references(np.concatenate([[0.0], grid])), dtype=np.float64)
        if params is not None and np.ndim(params) == 2 and len(states) == 1:
            states = np.repeat(states, len(np.asarray(params)), axis=0)
        needs_phase = "phase" in self.layout_ or getattr(self.baseline_, "has_origin_", False)
        if needs_phase and phase is None:
            raise MissingFieldError(
                f"{type(self).__name__} was fitted with a phase (time_origin): give phase=, the "
                "time since the motion began, at the start."
            )
        n = len(states)
        ds = planned(
            states,
            np.concatenate([[0.0], grid]),
            params=broadcast(params, (n,), "params"),
            actions=broadcast(actions, (n, len(grid)), "actions"),
            references=broadcast(references, (n, len(grid) + 1), "references"),
            context={key: by_episode(value, n, key) for key, value in (context or {}).items()},
            phase=by_episode(np.nan if phase is None else phase, n, "phase"),
            state_names=self.state_names_,
        )
        use = "auto" if actions is None else "logged"
        forecast = self.forecast(
            ds,
            actions=use,
            policy=policy,
            return_std=return_std,
            n_samples=n_samples,
            random_state=random_state,
        )
        return forecast.at(chosen + 1)._replace(horizons=wanted)

    def planning_grid(
        self, horizons: Floats, *, references: bool
    ) -> tuple[Floats, NDArray[np.intp]]:
        """Times at which an episode that has only begun is to have states, for some horizons.

        Parameters
        ----------
        horizons : ndarray of shape (k,)
        references : bool
            Whether references are known at any time, so that more of them can be looked at.

        Returns
        -------
        times : ndarray of shape (h,)
            After the start.
        chosen : ndarray of shape (k,)
            Which of them are the horizons.
        """
        baseline = self.baseline_
        if isinstance(baseline, DynamicsEstimator) and baseline._rolls_out:
            return baseline._time_grid(horizons)
        grid, chosen = self._time_grid(horizons)
        return self._looked_at(grid, chosen) if references else (grid, chosen)

    def _time_grid(self, horizons: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Times to compute, and which of them are the horizons asked for."""
        return horizons, np.arange(len(horizons))

    def _looked_at(self, grid: Floats, chosen: NDArray[np.intp]) -> tuple[Floats, NDArray[np.intp]]:
        """The grid with all times at which references enter, and where `chosen` are in it."""
        return grid, chosen

    # -- checks ---------------------------------------------------------------------------

    def _checked(self, ds: TrajectoryDataset) -> TrajectoryDataset:
        ds = super()._checked(ds)
        given = {"params": len(ds.param_names), "references": len(ds.reference_names)}
        for block, width in given.items():
            if block not in self.layout_:
                continue
            fitted = len(self.layout_.columns[block])
            if block == "references":
                fitted = self.n_references_
            if fitted:
                ds.require(block, by=f"{type(self).__name__} (fitted with {block})")
            if width != fitted:
                raise ValueError(
                    f"the episodes have {width} {block}, the model was fitted on {fitted}."
                )
        return ds
