"""What a search maximises: the return that a model predicts for candidates."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.control._forecast_returns import Moments, RewardModel, Trajectories
from trajlearn.control._futures import (
    Situation,
    later,
    policy_of,
    predicts_rewards,
    reference_function,
)
from trajlearn.control._objective_checks import (
    check_answerable,
    checked_candidates,
    checked_starts,
    one_of,
    time_step,
    whole,
)
from trajlearn.control._returns import Quadrature, Returns, States
from trajlearn.control._signals import Signals, named_by
from trajlearn.exceptions import CalibrationWarning, DivergenceWarning, HorizonWarning
from trajlearn.trajectories._relabeler import generator
from trajlearn.trajectories.rewards import Reward, step_rewards

if TYPE_CHECKING:
    from trajlearn.control._gradient import ReturnGradient

__all__ = ["RISKS", "Assessment", "PredictedReturn"]

RISKS = ("mean", "expected", "lcb")

Floats = NDArray[np.float64]

# states predicted at once, of all steps and samples: about 10 MB an array of 4 states
_CHUNK_STATES = 2**18


@dataclass(frozen=True)
class Assessment:
    """What is predicted of m candidates.

    Attributes
    ----------
    value : ndarray of shape (m,)
        What is maximised.
    reward : ndarray of shape (m,)
        Predicted return, averaged over initial states: with ``risk="mean"`` that of the mean
        trajectories, else the mean return.
    std : ndarray of shape (m,) or None
        Standard deviation of the return, where trajectories were sampled.
    violation : ndarray of shape (m,) or None
        Share of the sampled trajectories with a state that the constraint forbids.
    expected : ndarray of shape (m,) or None
        Mean return, which `std` is about; None where there is no `std`.
    """

    value: Floats
    reward: Floats
    std: Floats | None
    violation: Floats | None
    expected: Floats | None = None


class PredictedReturn:
    r"""Return that a fitted model predicts for control parameters, or for sequences of actions.

    The return of a trial is the sum of its step rewards over `horizon` steps,

    .. math:: R(\theta) = \frac1{n_0} \sum_{i=1}^{n_0} \sum_{t=1}^{H} r(\hat s_t(s_0^i, \theta)),

    averaged over the initial states. With ``risk="mean"`` it is that of the mean trajectories,
    and no uncertainty is asked for unless there is a constraint. With ``risk="expected"``
    trajectories are sampled (one member of an ensemble and one path of noise each), and what is
    maximised is the mean of their returns; with ``risk="lcb"`` it is that less `kappa` standard
    deviations. All candidates get the same random numbers, at every call, so that an optimiser
    sees one fixed function.

    A trajectory that enters `is_terminal` earns the reward of that step, and `terminal_reward`
    for each step after it, as a real trial does in
    `trajlearn.trajectories.rewards.episode_rewards`; one that diverges earns it from there on.

    Parameters
    ----------
    model : estimator
        Fitted. Anything with `predict_trajectory`; a `Pipeline` or whatever else has a `predict`
        of episodes; or `DirectRewardGP` or `DirectRewardNN` of the mean reward per step, fitted
        on episodes or on rows ``[s_0 | params]``, for which reward, termination and `every` are
        of no matter.
    reward : callable
        ``reward(states (..., d_s)) -> (...)`` of the states that steps lead into; it may also
        name `actions`, `references` and `times`.
    horizon : int
        Steps of a trial.
    dt : float or None, default=None
        Time of a step. None: ``model.dt_``.
    initial_states : array-like of shape (n0, d_s) or (d_s,)
    risk : {"mean", "expected", "lcb"}, default="mean"
        See the Notes for where "mean", the fastest, misleads. A direct reward model predicts an
        expected return either way.
    kappa : float, default=1.0
        Standard deviations of a lower confidence bound; with 0 it is "expected".
    n_samples : int, default=20
        Trajectories sampled for each candidate and initial state, for "expected", "lcb" and a
        constraint.
    is_terminal : callable or None, default=None
        ``is_terminal(states (..., d_s)) -> bool (...)``: whether a trial ends there.
    terminal_reward : float or None, default=None
        Of each step after the end; `is_terminal` needs it, or crashing early might pay. Without
        it a trajectory that diverges is worth -inf.
    constraint : callable or None, default=None
        ``constraint(states (..., d_s)) -> bool (...)``, True where a state is allowed.
    every : int, default=1
        Predict each `every`-th step and the last, with rewards linear in between; the initial
        state's own reward is a knot of the line if the reward takes states alone. A trajectory
        model is that much faster; a trial that would end in between ends at the next of them.
    decision : {"params", "actions"}, default="params"
        "actions": a candidate is a sequence of actions, for a model that was fitted with them.
    policy : callable or None, default=None
        ``policy(states, params, times) -> actions``, for one-step models (None: their own) and
        for a reward that names `actions`.
    references : array-like or callable, optional
        ``references(times (n,)) -> (n, d_r)``, or values of shape (horizon + 1, d_r), a row a
        step from `start_time` on; more rows if `starting_at` a later time is to follow.
    context : mapping from name to value, optional
    phase : float, optional
        Time since `time_origin` at the start.
    start_time : float, default=0.0
        Time at the initial states: what policy, references and a reward of `times` count from.
    state_names : sequence of str, optional
        Of the initial states, for a `Pipeline` that selects states by name.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    horizons : ndarray of shape (k,)
        Times after the start at which states are predicted.
    weights : ndarray of shape (k,)
        A return is ``start_part + rewards at the horizons @ weights``, unless it ends early.
    start_part : ndarray of shape (n0,)
    initial_states : ndarray of shape (n0, d_s)
    terminal_reward : float
        -inf if none was given.

    Raises
    ------
    NotFittedError
        If the model is not fitted.
    ValueError
        If a parameter is wrong; when called, if candidates have another shape, or a reward is
        NaN.

    Notes
    -----
    The return of the mean trajectory is not the mean return. Where trials may go either way, as
    with a pendulum that falls to the left or to the right, the mean of both goes neither way: it
    stays upright, and "mean" rates a controller that falls as highly as one that balances.
    "expected" costs `n_samples` times as many trajectories and does not have this fault.

    Examples
    --------
    The state settles at a rate theta; the reward is greatest where it settles at once.

    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> from trajlearn.control import PredictedReturn
    >>> rate = np.linspace(0.5, 1.5, 20)
    >>> states = np.exp(-rate[:, None] * 0.1 * np.arange(31))[..., None]
    >>> ds = TrajectoryDataset.from_arrays(states, params=rate[:, None], dt=0.1)
    >>> model = TrajectoryRegressor(random_state=0).set_params(estimator__max_steps=300).fit(ds)
    >>> objective = PredictedReturn(
    ...     model, reward=lambda s: -s[..., 0], horizon=30, dt=0.1, initial_states=[1.0]
    ... )
    >>> found = objective([[0.6], [1.0], [1.4]]).reward
    >>> bool(np.abs(found - [-13.5, -9.0, -6.6]).max() < 0.5)
    True
    """

    def __init__(
        self,
        model: Any,
        *,
        reward: Reward,
        horizon: int,
        dt: float | None = None,
        initial_states: ArrayLike,
        risk: str = "mean",
        kappa: float = 1.0,
        n_samples: int = 20,
        is_terminal: States | None = None,
        terminal_reward: float | None = None,
        constraint: States | None = None,
        every: int = 1,
        decision: str = "params",
        policy: Any = None,
        references: ArrayLike | Callable[[Floats], ArrayLike] | None = None,
        context: Mapping[str, Any] | None = None,
        phase: float | None = None,
        start_time: float = 0.0,
        state_names: Sequence[str] | None = None,
        random_state: Any = None,
    ) -> None:
        self.model, self.reward, self.constraint = model, reward, constraint
        self.horizon, self.every = whole(horizon, "horizon"), whole(every, "every")
        self.n_samples, self.kappa = whole(n_samples, "n_samples"), float(kappa)
        self.risk = one_of(RISKS, risk, "risk")
        self.decision = one_of(("params", "actions"), decision, "decision")
        if not self.kappa >= 0:
            raise ValueError(f"kappa = {kappa!r} must be at least 0.")
        if is_terminal is not None and terminal_reward is None:
            raise ValueError(
                "is_terminal= needs terminal_reward=, what each step after the end is worth: "
                "without it crashing early might pay."
            )
        self.is_terminal = is_terminal
        self.terminal_reward = -np.inf if terminal_reward is None else float(terminal_reward)
        named = named_by(reward)
        check_answerable(
            model,
            decision=self.decision,
            constrained=constraint is not None,
            needs_actions="actions" in named,
            every=self.every,
        )
        self._direct, self.dt = predicts_rewards(model), time_step(dt, model)
        self.policy = policy_of(model, policy)
        self.references = None
        if references is not None:
            self.references = reference_function(
                references, self.dt, self.horizon, float(start_time)
            )
        self.context, self.phase = dict(context or {}), phase
        self._state_names = None if state_names is None else tuple(state_names)
        self._seed = int(generator(random_state).integers(2**62))
        # shared with copies for other initial states
        self._warned: set[bool] = set()
        self._named, self._rule = named, Quadrature.of(self.horizon, self.every, bool(named))
        self.horizons: Floats = np.asarray(self.dt * self._rule.steps)
        self.weights = self._rule.weights
        self._begin_at(initial_states, float(start_time))

    def starting_at(self, initial_states: ArrayLike, *, time: float | None = None) -> Self:
        """The same objective from other initial states, as in planning step after step.

        Parameters
        ----------
        initial_states : array-like of shape (n0, d_s) or (d_s,)
        time : float or None, default=None
            Time there, by which the phase moves on, too; None leaves both as they are.

        Returns
        -------
        PredictedReturn
        """
        other = copy(self)
        if time is not None and self.phase is not None:
            other.phase = self.phase + time - self.start_time
        other._begin_at(initial_states, self.start_time if time is None else float(time))
        return other

    def __call__(self, candidates: ArrayLike) -> Assessment:
        """Assess candidates.

        Parameters
        ----------
        candidates : array-like of shape (m, p), or (m, horizon, d_a) for actions

        Returns
        -------
        Assessment

        Raises
        ------
        NoUncertaintyError
            If trajectories are to be sampled and the model cannot.
        ValueError
            If candidates have another shape or are not finite, or a reward is NaN.
        """
        given = checked_candidates(candidates, self.horizon if self.decision == "actions" else None)
        states = self.horizon * len(self.initial_states) * self._n_drawn
        size = max(_CHUNK_STATES // states, 1)
        with warnings.catch_warnings():
            # a diverged forecast has its value, and a search asks for thousands of them; what
            # holds of all forecasts alike is said once
            warnings.simplefilter("ignore", DivergenceWarning)
            parts = []
            for at in range(0, len(given), size):
                if self._warned:
                    warnings.simplefilter("ignore", HorizonWarning)
                    warnings.simplefilter("ignore", CalibrationWarning)
                parts.append(self._predict(given[at : at + size]))
                self._warned.add(True)
        reward = np.concatenate([part.reward for part in parts])
        expected, std, violation = (
            _joined([getattr(part, name) for part in parts])
            for name in ("expected", "std", "violation")
        )
        value = reward
        if self.risk == "lcb":
            assert std is not None  # a model that gives none has said so
            with np.errstate(invalid="ignore"):
                value = np.where(np.isfinite(reward), reward - self.kappa * std, -np.inf)
        return Assessment(value, reward, std, violation, expected)

    def gradient(self) -> "ReturnGradient":
        """The derivative of the predicted return in theta, of a model that has one.

        Returns
        -------
        callable
            From params (m, p) to returns (m,) and gradients (m, p).

        Raises
        ------
        ValueError
            If there is none; it says why.
        """
        from trajlearn.control._gradient import ReturnGradient

        reason = None
        if self.risk != "mean":
            reason = f"risk={self.risk!r} is computed from sampled trajectories"
        elif self.decision != "params":
            reason = f"decision={self.decision!r} is not over params"
        elif "actions" in self._named:
            reason = "the reward names actions, whose derivative is unknown"
        if reason is not None:
            raise ValueError(
                f"the predicted return has no gradient here: {reason}. Search without gradients "
                "(optimizer='cma')."
            )
        return ReturnGradient(self.model, self._situation, self._returns)

    def _begin_at(self, initial_states: ArrayLike, start_time: float) -> None:
        self.initial_states, self.start_time = checked_starts(initial_states), start_time
        policy, references = later(self.policy, self.references, start_time)
        self._situation = Situation(
            initial_states=self.initial_states,
            horizons=self.horizons,
            all_horizons=self.dt * np.arange(1.0, self.horizon + 1),
            policy=policy,
            references=references,
            context=self.context,
            phase=self.phase,
            state_names=self._state_names,
        )
        self.start_part = np.zeros(len(self.initial_states))
        if self._rule.start_weight and not self._direct:
            reward = step_rewards(self.reward, self.initial_states)
            self.start_part = self._rule.start_weight * reward
        self._returns = Returns(
            self.reward,
            self._rule,
            self.initial_states,
            self.start_part,
            Signals(
                self._named,
                self._situation,
                self._rule.steps,
                start_time,
                planned=self.decision == "actions",
            ),
            self.is_terminal,
            self.terminal_reward,
        )
        sampled = not self._direct and (self.risk != "mean" or self.constraint is not None)
        self._n_drawn = self.n_samples if sampled else 1
        self._predict: Callable[[Floats], Moments] = (
            RewardModel(self.model, self._situation, self.horizon, return_std=self.risk == "lcb")
            if self._direct
            else Trajectories(
                self.model,
                self._situation,
                self._returns,
                self.constraint,
                of_mean=self.risk == "mean",
                n_samples=self.n_samples if sampled else None,
                seed=self._seed,
            )
        )


def _joined(parts: Sequence[Floats | None]) -> Floats | None:
    return None if parts[0] is None else np.concatenate([p for p in parts if p is not None])
