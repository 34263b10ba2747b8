"""One-step models: the next state from state and action (or theta), rolled out."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from trajlearn._sklearn import StrOptions
from trajlearn.dynamics._forecaster import Prediction, Request
from trajlearn.dynamics._learner import (
    FullMoments,
    Moments,
    by_member,
    n_members_of,
    own_moments_of,
    required,
)
from trajlearn.dynamics._propagation_gaussians import TransitionStep, roll_gaussians
from trajlearn.dynamics._propagation_gp import gp_moments, has_exact_moments
from trajlearn.dynamics._propagation_particles import drawn_step, expected_step, member_step
from trajlearn.dynamics._propagation_steps import Image, linearised, mean_only, unscented
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rolling import RollingEstimator
from trajlearn.dynamics._rollout import Floats, InputRows, Step
from trajlearn.dynamics.propagation import BY_GAUSSIANS, PROPAGATIONS
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TransitionRelabeler

__all__ = ["OneStepRegressor"]


class OneStepRegressor(RollingEstimator):
    """One-step dynamics: (s_t, a_t) -> s_{t+1}, or closed loop (s_t, theta) -> s_{t+1}, rolled out.

    ``actions[t]`` takes s_t to s_{t+1}. A roll-out replays the logged actions, or lets a policy
    recompute them from the predicted states; with ``inputs="params"`` it needs neither. D, P, DE
    and PE of the paper are the choices ``n_members`` and ``probabilistic`` of the learner.

    `propagation` says how the members' differences and noise are carried along; it is read when
    a forecast is made, so that ``set_params(propagation=...)`` changes the next one. See
    `trajlearn.dynamics.propagation` for what each keeps and costs.

    Parameters
    ----------
    estimator : regressor or None, default=None
        Any scikit-learn regressor; None: `MLPEnsembleRegressor` with batches of 128.
    relabeler : TransitionRelabeler or None, default=None
        None: ``TransitionRelabeler(inputs=inputs)``.
    scaler : transformer or None, default=None
        None: `BlockScaler`.
    inputs : {"action", "params"} or sequence of str, default="action"
        What the model sees beside the state, see `TransitionRelabeler`; "params" is the
        closed-loop variant. Ignored if `relabeler` is given.
    target : {"change", "state"}, default="change"
        Learn s_{t+1} - s_t, or s_{t+1} itself.
    baseline : {"mean", None}, callable or forecaster, default=None
        What states are relative to, as in `TrajectoryRegressor`: a callable of the references
        makes it a model of the tracking error. The references (for another baseline, its states)
        have to be among the inputs, as they are with ``inputs="params"``. A policy still gets
        the states themselves; `clip_states` is about the deviation.
    policy : callable or None, default=None
        ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``, for roll-outs.
    rollout_actions : {"auto", "logged", "policy"}, default="auto"
        "auto": the policy if there is one, else the logged actions.
    clip_states : float or None, default=None
        Clip predicted states to this multiple of the training range about its centre.
    propagation : {"tsinf", "ts1", "expectation", "moment", "unscented"}, default="tsinf"
        Particles that keep one member ("tsinf"), draw one at every step ("ts1"), or draw from
        one Gaussian with the mean and total variance of all members ("expectation"); the mean of
        the forecast then averages the members at every step. Or a Gaussian for each member, by
        the slopes of the step ("moment"; exact for a `GPRegressor` with the RBF kernel) or by
        sigma points ("unscented"); the mean is then the mean of what is propagated.
    n_particles : int, default=50
        Particles behind a standard deviation; "moment" and "unscented" need none.
    error_score : float, default=-1e12
        Score of an episode whose forecast diverged.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_, relabeler_, scaler_
        As fitted.
    layout_ : mapping from block to slice
    dt_ : float or None
        Time step of the training episodes; None where it is an input or unknown (rows).
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest training states.
    action_range_ : ndarray of shape (2, d_a)
        The same of the actions, where the action before is among the inputs.
    baseline_ : forecaster or None
    n_features_in_ : int

    See Also
    --------
    TrajectoryRegressor : any horizon in one evaluation.

    References
    ----------
    K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", NeurIPS 2018 (TS1, TSinf).
    M. P. Deisenroth and C. E. Rasmussen, "PILCO: A Model-Based and Data-Efficient Approach to
    Policy Search", ICML 2011 ("moment" with a GP).

    Examples
    --------
    A linear system is identified exactly, because actions are aligned:

    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import OneStepRegressor, TrajectoryDataset
    >>> actions = np.random.default_rng(0).normal(size=(3, 20, 1))
    >>> states = np.zeros((3, 21, 1))
    >>> for t in range(20):
    ...     states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    >>> ds = TrajectoryDataset.from_arrays(states, actions=actions)
    >>> model = OneStepRegressor(LinearRegression()).fit(ds)
    >>> bool(np.allclose(model.predict(ds), states[:, 1:]))
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **RollingEstimator._parameter_constraints,
        "propagation": [StrOptions(set(PROPAGATIONS))],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        inputs: str | Sequence[str] = "action",
        target: str = "change",
        baseline: Any = None,
        policy: Any = None,
        rollout_actions: str = "auto",
        clip_states: float | None = None,
        propagation: str = "tsinf",
        n_particles: int = 50,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.relabeler = relabeler
        self.scaler = scaler
        self.inputs = inputs
        self.target = target
        self.baseline = baseline
        self.policy = policy
        self.rollout_actions = rollout_actions
        self.clip_states = clip_states
        self.propagation = propagation
        self.n_particles = n_particles
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {
            "estimator": MLPEnsembleRegressor(batch_size=128),
            "relabeler": TransitionRelabeler(inputs=self.inputs),
            "scaler": BlockScaler(),
        }

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        if "previous" in self.layout_:
            actions = rows[:, self.layout_["action"]]
            self.action_range_ = np.stack([actions.min(axis=0), actions.max(axis=0)])
        super()._fit_rows(rows, targets, weight, groups)

    # -- forecasting ----------------------------------------------------------------------

    def _step(self, query: Query, copies: int, rng: np.random.Generator | None) -> Step:
        if rng is None:
            return expected_step(self._moments(means_only=True))
        if self.propagation == "expectation":
            return drawn_step(self._full(self._moments()), rng)
        n_members = n_members_of(self.estimator_)
        moments = by_member(self._full(self._own_moments()), n_members)
        if self.propagation == "ts1":
            return member_step(moments, n_members, rng)
        member = np.repeat(rng.permutation(np.arange(copies) % n_members), len(query))
        return member_step(moments, member, rng)

    def _own_moments(self) -> Moments:
        """Function from raw rows of each member's own (E, n, k) to means and variances."""
        learner = own_moments_of(self.estimator_)

        def moments(rows: Floats) -> tuple[Floats, Floats | None]:
            scaled = self._scaled(rows.reshape(-1, rows.shape[-1]))
            means, variances = learner(scaled.reshape(*rows.shape[:2], -1))
            known = np.zeros_like(means) if variances is None else variances
            means, known = self._restore(rows, means, known)
            return means, None if variances is None else known

        return moments

    def _full(self, moments: Moments, *, needed: bool = True) -> FullMoments:
        """The same with variances, which are zero where there are none and none is `needed`."""

        def full(rows: Floats) -> tuple[Floats, Floats]:
            means, variances = moments(rows)
            if variances is None and not needed:
                return means, np.zeros_like(means)
            return means, required(variances, self.estimator_)

        return full

    def _rolled_out(self, query: Query, request: Request, inputs: InputRows) -> Prediction:
        if self.propagation not in PROPAGATIONS:
            # fit has checked it, but it may have been set since
            raise ValueError(
                f"propagation = {self.propagation!r}; choose one of {sorted(PROPAGATIONS)}."
            )
        if self.propagation not in BY_GAUSSIANS:
            return super()._rolled_out(query, request, inputs)
        initial, n_samples = query.initial_states, request.n_samples or 0
        uncertain = request.return_std or bool(n_samples)
        if "previous" in self.layout_:
            # what stands for an action before the start is not read
            before = np.zeros((len(query), len(self.layout_.columns["previous"])))
            initial = np.concatenate([initial, before], axis=1)
        rolled = roll_gaussians(
            initial,
            query.n_steps,
            n_members_of(self.estimator_),
            self._transition(inputs, uncertain=uncertain),
            self._limits(),
            n_samples=n_samples,
            rng=request.rng,
        )
        std = rolled.std if request.return_std else None
        return Prediction(rolled.mean, std, rolled.samples)

    def _transition(self, inputs: InputRows, *, uncertain: bool) -> TransitionStep:
        """Step of the members' Gaussians."""
        moments = self._full(self._own_moments(), needed=uncertain)
        image = Image(inputs, moments, self._limits(), carries="previous" in self.layout_)
        width = self._widths()
        if self.propagation == "unscented":
            return unscented(image, len(width))
        if has_exact_moments(self.estimator_):
            return gp_moments(
                self.estimator_,
                image,
                self._scaled,
                width,
                target_scale=self.target_scale_,
                change=self.target == "change",
            )
        return linearised(image, width) if uncertain else mean_only(image)

    def _widths(self) -> Floats:
        """Training range of each number of a point: state, and action before if it is an input."""
        width = np.ptp(self.rolled_range_, axis=0)
        if "previous" in self.layout_:
            width = np.concatenate([width, np.ptp(self.action_range_, axis=0)])
        return np.where(width > 0, width, 1.0)
