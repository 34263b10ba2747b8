"""One-step models: the next state from state and action (or theta), rolled out."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.dynamics._denoising.denoised import DenoisedEstimator
from trajlearn.dynamics._forecaster import Prediction, Request
from trajlearn.dynamics._learner import (
    FullMoments,
    Moments,
    by_member,
    n_members_of,
    own_moments_of,
    required,
)
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rollouts.rollout import Floats, InputRows, Step
from trajlearn.dynamics._rollouts.unrolled import check_unrollable, train_on_rollouts
from trajlearn.dynamics.propagation import BY_GAUSSIANS, PROPAGATIONS
from trajlearn.dynamics.propagation._gaussians import TransitionStep, roll_gaussians
from trajlearn.dynamics.propagation._gp import gp_moments, has_exact_moments
from trajlearn.dynamics.propagation._particles import drawn_step, expected_step, member_step
from trajlearn.dynamics.propagation._steps import Image, linearised, mean_only, unscented
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler
from trajlearn.trajectories._layout import Layout

__all__ = ["OneStepRegressor"]


class OneStepRegressor(DenoisedEstimator):
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
    history : int, default=1
        States that the model sees, for plants whose state is logged in part: the last `history`
        states and the actions between them, see `TransitionRelabeler`. A forecast reads those
        before its start; before the first state of an episode that state is repeated, and actions
        are zero. A cloned policy sees the same window, a given one the newest state. Not with
        "moment" and "unscented". Ignored if `relabeler` is given.
    target : {"change", "state"}, default="change"
        Learn s_{t+1} - s_t, or s_{t+1} itself.
    baseline : {"mean", None}, callable or forecaster, default=None
        What states are relative to, as in `TrajectoryRegressor`: a callable of the references
        makes it a model of the tracking error. The references (for another baseline, its states)
        have to be among the inputs, as they are with ``inputs="params"``. A policy still gets
        the states themselves; `clip_states` is about the deviation.
    policy : callable, "clone" or None, default=None
        ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``, for roll-outs.
        "clone": learn it from the logged actions, as a function of the state, theta, and context
        and references where they are logged; actions are clipped to the range of those logged. A
        controller with a memory of its own (an integral, a filter) is no such function;
        `history` shows it a few states more.
    policy_estimator : regressor or None, default=None
        What learns the policy from scaled rows; any scikit-learn regressor. None:
        `ControlLawRegressor`, which finds linear feedback with gains in theta exactly.
    policy_sees : {"states", "measurements"}, default="states"
        What the logged controller acted on, where the states are logged with noise: the states
        themselves, or the measurements that are logged. With "measurements" the policy, given or
        cloned, acts in a roll-out on predicted states with noise of `measurement_noise_`, for
        which `denoise` is needed. The mean of a forecast is then that of `n_particles`
        roll-outs, always the same ones. Not with "moment" and "unscented", and not with
        `latent_velocities`: no log tells which velocities a controller acted on.
    rollout_actions : {"auto", "logged", "policy"}, default="auto"
        "auto": the policy if there is one, else the logged actions.
    clip_states : float or None, default=None
        Clip predicted states to this multiple of the training range about its centre.
    denoise : {"em", None}, default=None
        "em": errors-in-variables training, for states that are logged with noise. The learned
        step smooths the logged states, with the logged actions and the noise as it shows in the
        residuals of one step, and is learned again from the result, several times. A forecast
        then starts from the state that is filtered from the measurements up to the start and the
        starts seen in training, and `std` is that of the true state, what is not known of the
        start included; what will be measured has `measurement_noise_` on top. Without
        measurement noise that matters the model is that of None, to the bit. Any learner will
        do; the slopes of networks and of polynomials are exact. Not with weights, rows, or
        `history`.
    latent_velocities : bool, default=False
        The states are positions, and the plant has velocities that nobody logged: they become
        part of the state, ``[positions, velocities]``, and are smoothed as by `denoise`, which
        this includes. Forecasts are of positions. At the start of an episode velocities are
        taken to be as they were in training at such positions. A policy, given or cloned, is
        told the whole state (n, 2 d_s), velocities per unit of time.
    loss_horizon : int, default=1
        Steps of the roll-outs that the network is trained on after it has learned single steps:
        first of two steps, then four, eight, and so on up to this. They take actions from where
        forecasts do: the policy if there is one, else the log. Makes it robust to noise in the
        states (where `denoise` can be used, that is better and faster); without noise nothing is
        gained. Each member keeps the weights of the round that forecasts `loss_horizon` steps of
        training episodes best. Training takes time in proportion, and beyond about 25 steps
        little is gained. For an `MLPEnsembleRegressor` behind a `BlockScaler`, on episodes.
    loss_discount : float, default=0.95
        Weight of a step of a roll-out, in that of the step before.
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
    policy_ : callable
        The cloned policy, ``policy(states, params, times) -> actions``; with ``policy="clone"``.
    noisy_ : bool
        Whether measurement noise was found; with `denoise` or `latent_velocities`, as what follows.
    measurement_noise_ : ndarray of shape (d_s,)
        Standard deviation of the measurement noise of each state, zero if none was found.
    process_noise_ : ndarray of shape (d_s,)
        The same of what a step leaves open: process noise, and what the learner misses. It is the
        noise of particles where the learner gives less or none. With latent velocities (2 d_s,).
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
    Z. Ghahramani and S. T. Roweis, "Learning Nonlinear Dynamical Systems Using an EM Algorithm",
    NeurIPS 1998 (`denoise`).
    A. Venkatraman, M. Hebert and J. A. Bagnell, "Improving Multi-Step Prediction of Learned Time
    Series Models", AAAI 2015 (`loss_horizon`).

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

    From noisy states least squares learns a slope that is too small, and `denoise` the right one:

    >>> actions = np.random.default_rng(1).normal(size=(20, 60, 1))
    >>> states = np.zeros((20, 61, 1))
    >>> for t in range(60):
    ...     states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    >>> noisy = TrajectoryDataset.from_arrays(states, actions=actions).add_noise(
    ...     0.3, random_state=0
    ... )
    >>> for denoise in (None, "em"):
    ...     model = OneStepRegressor(LinearRegression(), target="state", denoise=denoise).fit(noisy)
    ...     ahead = model.predict(np.array([[0.0, 0.0], [1.0, 0.0]]))
    ...     print(f"{ahead[1, 0] - ahead[0, 0]:.2f}")
    0.83
    0.90
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **DenoisedEstimator._parameter_constraints,
        "history": [Interval(Integral, 1, None, closed="left")],
        "policy_sees": [StrOptions({"states", "measurements"})],
        "loss_horizon": [Interval(Integral, 1, None, closed="left")],
        "loss_discount": [Interval(Real, 0, 1, closed="right")],
        "propagation": [StrOptions(set(PROPAGATIONS))],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        inputs: str | Sequence[str] = "action",
        history: int = 1,
        target: str = "change",
        baseline: Any = None,
        policy: Any = None,
        policy_estimator: Any = None,
        policy_sees: str = "states",
        rollout_actions: str = "auto",
        clip_states: float | None = None,
        denoise: str | None = None,
        latent_velocities: bool = False,
        loss_horizon: int = 1,
        loss_discount: float = 0.95,
        propagation: str = "tsinf",
        n_particles: int = 50,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.relabeler = relabeler
        self.scaler = scaler
        self.inputs = inputs
        self.history = history
        self.target = target
        self.baseline = baseline
        self.policy = policy
        self.policy_estimator = policy_estimator
        self.policy_sees = policy_sees
        self.rollout_actions = rollout_actions
        self.clip_states = clip_states
        self.denoise = denoise
        self.latent_velocities = latent_velocities
        self.loss_horizon = loss_horizon
        self.loss_discount = loss_discount
        self.propagation = propagation
        self.n_particles = n_particles
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {
            "estimator": MLPEnsembleRegressor(batch_size=128),
            "relabeler": TransitionRelabeler(inputs=self.inputs, history=self.history),
            "scaler": BlockScaler(),
            **self._default_policy(),
        }

    def _layout_of_rows(self, n_features: int, n_targets: int) -> Layout:
        if self._history() > 1:
            raise ValueError(
                f"history={self._history()} needs episodes: rows do not say what came before. Fit "
                "on episodes, or give rows that hold the past and history=1."
            )
        return super()._layout_of_rows(n_features, n_targets)

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        if "previous" in self.layout_:
            actions = rows[:, self.layout_["action"]]
            self.action_range_ = np.stack([actions.min(axis=0), actions.max(axis=0)])
        super()._fit_rows(rows, targets, weight, groups)

    def _fit_door_of_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> None:
        if self.loss_horizon > 1:
            raise ValueError(
                f"loss_horizon={self.loss_horizon} needs episodes: rows do not say which follow "
                "others. Fit on episodes, or leave loss_horizon=1."
            )
        self._check_sight()
        super()._fit_door_of_rows(X, y, sample_weight, groups)

    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        self._check_sight()
        if self.loss_horizon > 1:
            check_unrollable(self)
        super()._fit_episodes(ds, weight, groups)
        if self.loss_horizon > 1:
            train_on_rollouts(self, self.smooth(ds), weight, self._rng)

    def _check_sight(self) -> None:
        if self.policy_sees == "states":
            return
        if self.latent_velocities:
            raise ValueError(
                'policy_sees="measurements" does not go with latent_velocities=True: the log does '
                "not tell which velocities the controller acted on. Leave one of the two out."
            )
        if self.denoise is None:
            raise ValueError(
                'policy_sees="measurements" needs to know how noisy they are: set denoise="em", or '
                'leave policy_sees="states".'
            )

    def _fit_policy(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        # actions are a function of what the controller acted on: the measurements in the log, or
        # the states behind them
        if self.policy_sees == "states" and getattr(self, "noisy_", False):
            ds = self.smooth(ds)
        super()._fit_policy(ds, weight, groups)

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

        return self._with_process_noise(moments)

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
        if self._history() > 1:
            raise ValueError(
                f"propagation={self.propagation!r} carries a Gaussian of one state, and "
                f'history={self._history()} shows the model several: use propagation="tsinf", '
                '"ts1" or "expectation".'
            )
        initial, n_samples = query.initial_states, request.n_samples or 0
        uncertain = request.return_std or bool(n_samples)
        if "previous" in self.layout_:
            # what stands for an action before the start is not read
            before = np.zeros((len(query), len(self.layout_.columns["previous"])))
            initial = np.concatenate([initial, before], axis=1)
        root = query.start_root
        if root is not None:
            wider = initial.shape[1] - root.shape[-1]
            root = np.pad(root, ((0, 0), (0, wider), (0, wider)))
        rolled = roll_gaussians(
            initial,
            query.n_steps,
            n_members_of(self.estimator_),
            self._transition(inputs, uncertain=uncertain),
            self._limits(),
            initial_root=root,
            n_samples=n_samples,
            rng=request.rng,
        )
        std = rolled.std if request.return_std else None
        return Prediction(rolled.mean, std, rolled.samples)

    def _unseen_by(self, source: str) -> Floats | None:
        if source != "policy" or self.policy_sees == "states":
            return None
        # fit has checked it, but it may have been set since
        self._check_sight()
        check_is_fitted(self, "measurement_noise_")
        if not self.measurement_noise_.any():
            return None
        if self.propagation in BY_GAUSSIANS:
            raise ValueError(
                f"propagation={self.propagation!r} cannot carry the noise of what a policy sees "
                '(policy_sees="measurements"): use "tsinf", "ts1" or "expectation".'
            )
        return self.measurement_noise_

    def _transition(self, inputs: InputRows, *, uncertain: bool) -> TransitionStep:
        """Step of the members' Gaussians."""
        moments = self._full(self._own_moments(), needed=uncertain)
        image = Image(inputs, moments, self._limits(), carries="previous" in self.layout_)
        width = self._widths()
        if self.propagation == "unscented":
            return unscented(image, len(width))
        if has_exact_moments(self.estimator_) and getattr(self, "noise_", None) is None:
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
