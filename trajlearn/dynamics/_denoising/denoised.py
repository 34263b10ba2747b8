"""One-step models that are trained on noisy states, and start from filtered ones."""

from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import StrOptions
from trajlearn.dynamics._denoising.errors_in_variables import (
    Smoother,
    estimate_noise,
    first_noise,
    round_learner,
    with_states,
)
from trajlearn.dynamics._denoising.latent_velocities import guessed_velocities, with_velocities
from trajlearn.dynamics._denoising.noise import NoiseModel
from trajlearn.dynamics._denoising.start_filter import filtered_starts
from trajlearn.dynamics._forecaster import DIVERGENCE_RANGES, Prediction, Request
from trajlearn.dynamics._learner import Moments
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._relative import curve, relative_to
from trajlearn.dynamics._rollouts.propagated import PropagatingEstimator
from trajlearn.dynamics._rollouts.rollout import Limits
from trajlearn.dynamics.baselines import CurveForecaster
from trajlearn.dynamics.propagation._algebra import root_of
from trajlearn.exceptions import MissingFieldError
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler, as_dataset
from trajlearn.trajectories._columns import Columns

__all__ = ["DenoisedEstimator", "as_measured"]

Floats = NDArray[np.float64]

# Standard deviation of measurement noise that is called none, in ranges.
_NOISE_FREE = 1e-4


class DenoisedEstimator(PropagatingEstimator):
    """One-step estimator with `denoise` and `latent_velocities`."""

    denoise: str | None
    latent_velocities: bool

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **PropagatingEstimator._parameter_constraints,
        "denoise": [StrOptions({"em"}), None],
        "latent_velocities": ["boolean"],
    }

    noise_: NoiseModel | None
    noisy_: bool

    # -- fitting --------------------------------------------------------------------------

    def _fit_door_of_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> None:
        if self.denoise is not None or self.latent_velocities:
            raise ValueError(
                f"{self._asked()} needs episodes: rows do not say which follow others."
            )
        self._forget()
        super()._fit_door_of_rows(X, y, sample_weight, groups)

    def _fit_states(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        given = self.__dict__.pop("_given_noise", None)
        self._forget()
        if self.denoise is None and not self.latent_velocities:
            super()._fit_states(ds, weight, groups)
            return
        self._refuse(weight)
        if given is not None:
            super()._fit_states(ds, None, groups)
            self._know(given)
        elif self.latent_velocities:
            self._fit_latent(ds, groups)
        else:
            self._fit_denoised(ds, groups)

    def _fit_denoised(self, ds: TrajectoryDataset, groups: NDArray[Any] | None) -> None:
        learner = self.estimator_
        trials = [clone(learner)]
        if isinstance(learner, MLPEnsembleRegressor):
            # a short training tells noise that is worth the while, and has learned little of it
            trials.insert(0, round_learner(learner))
        for self.estimator_ in trials:
            super()._fit_states(ds, None, groups)
            smoother = Smoother(self, ds, ds.states.shape[1])
            noise, residual = first_noise(smoother, ds.states)
            if noise is not None:
                self._fit_rounds(smoother, noise, groups, learner)
                return
        self.noisy_, self.measurement_noise_ = False, np.zeros(len(residual))
        self.process_noise_ = np.sqrt(residual)

    def _fit_latent(self, ds: TrajectoryDataset, groups: NDArray[Any] | None) -> None:
        learner, m = self.estimator_, ds.states.shape[1]
        guesses, measurement = guessed_velocities(ds)
        trials: list[tuple[float, TrajectoryDataset]] = []
        for guess in guesses:
            smoother, noise = self._begun(guess, m, measurement, groups, learner)
            trials.append((smoother.deviance(guess.states, noise), guess))
        # likelihoods are of the same positions
        _, guess = min(trials, key=lambda trial: trial[0])
        smoother, noise = self._begun(guess, m, measurement, groups, learner)
        self._fit_rounds(smoother, noise, groups, learner)

    def _begun(
        self,
        guess: TrajectoryDataset,
        m: int,
        measurement: Floats,
        groups: NDArray[Any] | None,
        learner: Any,
    ) -> tuple[Smoother, NoiseModel]:
        """Fit to a guess of states, and tell the noise about it."""
        self.estimator_ = round_learner(learner)
        super()._fit_states(guess, None, groups)
        smoother = Smoother(self, guess, m)
        noise, _ = first_noise(smoother, guess.states, measurement)
        assert noise is not None  # there is some where it is given
        return smoother, noise

    def _fit_rounds(
        self,
        smoother: Smoother,
        noise: NoiseModel,
        groups: NDArray[Any] | None,
        learner: Any,
    ) -> None:
        """Estimate noise and states, and fit a clone of the learner on these."""
        ds = smoother.ds
        noise, states = estimate_noise(
            smoother, ds.states, noise, groups, latent=self.latent_velocities
        )
        self.estimator_ = clone(learner)
        super()._fit_states(with_states(ds, states), None, groups)
        self._know(noise)

    def _fit_smoothed(
        self, ds: TrajectoryDataset, noise: NoiseModel, groups: ArrayLike | None = None
    ) -> Self:
        """Fit on episodes that are smoothed already, with the noise that was found then."""
        self._given_noise = noise
        try:
            return self.fit(ds, groups=groups)
        finally:
            self.__dict__.pop("_given_noise", None)

    def _forget(self) -> None:
        for name in ("noise_", "noisy_", "measurement_noise_", "process_noise_"):
            self.__dict__.pop(name, None)

    def _know(self, noise: NoiseModel) -> None:
        m = len(noise.measurement)
        self.noise_ = noise
        # the states of a forecast are those that are measured
        self.state_range_, self.state_names_ = self.state_range_[:, :m], self.state_names_[:m]
        change = np.ptp(self.state_range_, axis=0) ** 2
        least = _NOISE_FREE**2 * change
        # a state that never changes has no range to tell noise by
        self.noisy_ = bool(((noise.measurement > least) & (least > 0)).any())
        self.measurement_noise_ = np.sqrt(noise.measurement)
        self.process_noise_ = np.sqrt(noise.process)

    def _refuse(self, weight: Floats | None) -> None:
        """Raise an error for what cannot be denoised."""
        why = None
        if weight is not None:
            why = "takes all episodes for equally noisy: leave sample_weight out"
        elif not isinstance(self.relabeler_, TransitionRelabeler):
            why = (
                "needs the row of every step, so a TransitionRelabeler; got "
                f"relabeler={type(self.relabeler_).__name__}"
            )
        elif self._history() > 1:
            why = f"smooths the state itself, not a window: leave history={self._history()} out"
        elif self.latent_velocities and self.baseline_ is not None:
            why = "knows no velocities of a baseline: leave baseline= out"
        elif not (self.baseline_ is None or isinstance(self.baseline_, CurveForecaster)):
            why = (
                f"does not go with baseline={type(self.baseline).__name__}, which starts from a "
                "noisy state itself: give a function of the references, 'mean', or None"
            )
        if why is not None:
            raise ValueError(f"{self._asked()} {why}.")

    def _asked(self) -> str:
        return "latent_velocities=True" if self.latent_velocities else f"denoise={self.denoise!r}"

    # -- smoothing ------------------------------------------------------------------------

    def smooth(self, X: Any) -> TrajectoryDataset:
        """States without measurement noise, each estimated from its whole episode.

        They are those of the fitted step that explain the measurements best, with the logged
        actions and the noise as found in `fit`: an extended Rauch-Tung-Striebel smoother.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory

        Returns
        -------
        TrajectoryDataset
            The measured states are its `observed`, and it is marked as made in `hindsight`.
            Episodes as they are if `fit` found no noise, or if they are marked already (and are
            not positions whose velocities are asked for).

        Raises
        ------
        MissingFieldError
            If the episodes have no actions and the model needs them.
        """
        check_is_fitted(self, "estimator_")
        ds, noise = as_dataset(X), getattr(self, "noise_", None)
        if noise is None:
            return ds
        # smoothed positions are without velocities still
        complete = not self._is_latent() or ds.states.shape[1] == len(noise.process)
        if ds.hindsight and complete:
            return ds
        ds = self._checked(ds)
        self._check_time_step(ds)
        m = ds.states.shape[1]
        if self._is_latent():
            return self._smoothed(with_velocities(ds), m, noise)
        if self.baseline_ is None:
            return self._smoothed(ds, m, noise)
        base = curve(self.baseline_, ds)
        found = self._smoothed(relative_to(ds, base, told=self._told()), m, noise)
        return with_states(ds, base + found.states)

    def _smoothed(self, ds: TrajectoryDataset, m: int, noise: NoiseModel) -> TrajectoryDataset:
        return with_states(ds, Smoother(self, ds, m).smoothed(ds.states, noise))

    # -- forecasting ----------------------------------------------------------------------

    def _forecast_states(self, query: Query, request: Request) -> Prediction:
        prediction = super()._forecast_states(self._filtered(query), request)
        if not self._is_latent():
            return prediction
        m = query.ds.states.shape[1]
        prediction.mean = prediction.mean[..., :m].copy()
        if prediction.std is not None:
            prediction.std = prediction.std[..., :m].copy()
        if prediction.samples is not None:
            prediction.samples = prediction.samples[..., :m].copy()
        return prediction

    def _limits(self) -> Limits:
        limits = super()._limits()
        if not self._is_latent():
            return limits
        width = np.ptp(self.rolled_range_, axis=0)
        return replace(limits, reach=DIVERGENCE_RANGES * np.where(width > 0, width, 1.0))

    def _is_latent(self) -> bool:
        """Whether the fitted step has velocities that episodes have not."""
        noise = getattr(self, "noise_", None)
        return noise is not None and len(noise.process) > len(noise.measurement)

    def _filtered(self, query: Query) -> Query:
        """The query with filtered starts, if there is noise."""
        noise = getattr(self, "noise_", None)
        if noise is None:
            return query
        self._check_time_step(query.ds)
        if "action" in self.layout_ and query.start.any():
            self._check_past_actions(query.ds)
        ds = with_velocities(query.ds) if self._is_latent() else query.ds
        query = replace(query, ds=ds)
        mean, covariance = filtered_starts(self, query, noise)
        states = ds.states.copy()
        states[query.rows] = mean
        columns = Columns(**(vars(ds._columns) | {"states": states}))
        ds = TrajectoryDataset._of(columns.freeze(), ds._names)
        return replace(query, ds=ds, start_root=root_of(covariance))

    def _check_past_actions(self, ds: TrajectoryDataset) -> None:
        if ds.actions is None:
            raise MissingFieldError(
                f"{self._asked()} estimates the state at the start from the measurements and the "
                "actions before it, but the episodes have no actions. Give them, or forecast from "
                "the first state."
            )
        self._check_action_width(ds)

    def _moments(self, *, means_only: bool = False) -> Moments:
        moments = super()._moments(means_only=means_only)
        return moments if means_only else self._with_process_noise(moments)

    def _own_moments(self) -> Moments:
        return self._with_process_noise(super()._own_moments())

    def _with_process_noise(self, moments: Moments) -> Moments:
        """Variances no less than the process noise: smoothed states show the learner too little."""
        noise = getattr(self, "noise_", None)
        if noise is None:
            return moments

        def with_noise(rows: Floats) -> tuple[Floats, Floats | None]:
            means, variances = moments(rows)
            least = np.broadcast_to(noise.process, means.shape)
            return means, least if variances is None else np.maximum(variances, least)

        return with_noise


def as_measured(ds: TrajectoryDataset) -> TrajectoryDataset:
    """Episodes with the states that were measured, where they are smoothed."""
    if not ds.hindsight or ds.observed is None or ds.observed_names != ds.state_names:
        return ds
    columns = Columns(**(vars(ds._columns) | {"states": ds.observed, "hindsight": False}))
    return TrajectoryDataset._of(columns, ds._names)
