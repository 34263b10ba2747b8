"""One-step models: the next state from state and action (or theta), rolled out."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.dynamics._denoising.denoised import DenoisedEstimator, as_measured
from trajlearn.dynamics._rollouts.unrolled import check_unrollable, train_on_rollouts
from trajlearn.dynamics.propagation import BY_GAUSSIANS
from trajlearn.dynamics.propagation._gp import has_exact_moments
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler
from trajlearn.trajectories._layout import Layout

__all__ = ["OneStepRegressor"]

Floats = NDArray[np.float64]

_NO_VELOCITIES = (
    'policy_sees="measurements" does not go with latent_velocities=True: the log does not tell '
    "which velocities the controller acted on. Leave one of the two out, and fit again."
)


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
        forecasts do: the policy if there is one, else the log. For states with noise where
        `denoise` cannot be used (with weights, or a `history`): the noise counts less in what is
        learned from roll-outs, but a forecast still starts from the measured state. Each member
        keeps the weights of the round that forecasts `loss_horizon` steps of training episodes
        best. Training takes time in proportion. For an `MLPEnsembleRegressor` behind a
        `BlockScaler`, on episodes.
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
            raise ValueError(_NO_VELOCITIES)
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
        if self.policy_sees == "measurements":
            ds = as_measured(ds)
        elif self._is_latent() or getattr(self, "noisy_", False):
            ds = self.smooth(ds)
        super()._fit_policy(ds, weight, groups)

    # -- forecasting ----------------------------------------------------------------------

    def _has_exact_moments(self) -> bool:
        # those of the learner are without the process noise
        return has_exact_moments(self.estimator_) and getattr(self, "noise_", None) is None

    def _unseen_by(self, source: str) -> Floats | None:
        if source != "policy" or self.policy_sees == "states":
            return None
        # fit has checked it, but it may have been set since
        self._check_sight()
        if self._is_latent():
            raise ValueError(_NO_VELOCITIES)
        check_is_fitted(
            self,
            "measurement_noise_",
            msg='policy_sees="measurements" was set after a fit that did not look for measurement '
            'noise: fit again with denoise="em".',
        )
        if not self.measurement_noise_.any():
            return None
        if self.propagation in BY_GAUSSIANS:
            raise ValueError(
                f"propagation={self.propagation!r} cannot carry the noise of what a policy sees "
                '(policy_sees="measurements"): use "tsinf", "ts1" or "expectation".'
            )
        return self.measurement_noise_
