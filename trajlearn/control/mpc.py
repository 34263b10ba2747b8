"""Model-predictive control: plan from the current state, act for a while, plan again."""

from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.random import RandomState
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state
from tqdm import tqdm

from trajlearn.control._decisions import Plan
from trajlearn.control._objective_checks import whole
from trajlearn.control._planner import Planner, one_state
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.edits import assign, concatenate

if TYPE_CHECKING:
    from trajlearn.envs.base import Environment

__all__ = ["MPC", "Plan"]

Floats = NDArray[np.float64]


class MPC(Planner):
    """Plan with a fitted model from the current state, act for `hold` steps, and plan again.

    What is decided is the parameters theta of a controller, which then closes the loop at every
    step, or, with a one-step model, a sequence of actions. `run` drives a simulator; on a robot,
    call `reset` before each trial and `act` at each step. `plan` makes a single decision.

    With ``hold=1`` the loop is closed at every step, with ``hold="all"`` a trial follows what was
    planned from its first state.

    Parameters
    ----------
    model : dynamics estimator, Pipeline that ends in one, or direct reward model
        Fitted. Actions are planned with `OneStepRegressor` or `LSTMRegressor`.
    bounds : array-like of shape (p, 2), or (d_a, 2) for actions
        Lower and upper bounds of what is decided, lower first.
    reward : callable
        ``reward(states (..., d_s)) -> (...)``, of stepping into a state.
    horizon : int
        Steps to plan ahead; the return that is maximised is the sum of their rewards.
    dt : float or None, default=None
        Time of a step; None: that of the environment in `run`, of training elsewhere.
    policy : callable or None, default=None
        ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``, the controller
        whose parameters are decided; None: that of the model. To act, though not to plan, `run`
        falls back on the environment's.
    decision : {"params", "actions"}, default="params"
        What is decided.
    optimizer : {"random", "cem", "cma"}, default="random"
        Random shooting, cross-entropy method or CMA-ES.
    n_candidates : int, default=1000
        Candidates assessed for a decision.
    hold : int or "all", default=1
        Steps for which a decision is followed. "all": for the whole trial, or to the end of the
        planned actions.
    every : int, default=1
        Take rewards from every `every`-th step only, linear in between (and the last). A
        trajectory model computes nothing else; a one-step model has to go through all steps.
    beyond_end : bool, default=False
        Whether `run` plans `horizon` steps ahead up to the last step. By default it plans no
        further than the end of the trial, which is when rewards stop counting.
    is_terminal : callable or None, default=None
        ``is_terminal(states (..., d_s)) -> bool (...)``: a predicted trajectory ends where it
        enters such a state.
    terminal_reward : float or None, default=None
        What each step after a predicted end, or divergence, earns; `is_terminal` needs it, or
        ending early might pay.
    risk : {"mean", "expected", "lcb"}, default="mean"
        Maximise the return of the mean trajectory, the mean return of sampled trajectories, or
        that less `kappa` standard deviations; see the Notes.
    kappa : float, default=1.0
    n_samples : int, default=20
        Trajectories drawn for each candidate, for "expected", "lcb" and a constraint.
    constraint : callable or None, default=None
        ``constraint(states (..., d_s)) -> bool (...)``, True where the state is allowed.
    max_violation : float, default=0.05
        Largest share of predicted trajectories that may break the constraint. Where no candidate
        keeps it, the one that breaks it least is taken, as something has to be done.
    warm_start : bool, default=True
        Begin the search with the decision before: the same theta, or the sequence of actions
        shifted by the steps held, its last action repeated.
    verbose : int, default=0
        Show the progress of `run`.
    random_state : int, RandomState or None, default=None
        Every decision draws candidates of its own; the same seed gives the same bits.

    Attributes
    ----------
    decisions_ : DataFrame
        One row a decision, since `run` began or since the first `act` or `plan`: ``trial``,
        ``step``, ``seconds`` of wall clock, and ``value``, the predicted return over what was
        planned.
    seed_ : int

    See Also
    --------
    PredictedReturn : what is maximised.

    Notes
    -----
    A candidate's theta is meant to stay as it is for all of the horizon. Data from a trial in
    which it changed are still data: `run` logs theta_t at each step, and `SubtrajectoryRelabeler`
    draws from stretches in which it is constant. With ``hold=1`` these are single steps.

    ``risk="mean"`` is the fastest and usually enough with a short `hold`, as the next decision
    mends the last. Where an unstable system may fall to either side within the horizon, the mean
    trajectory stays upright, and "mean" over-rates candidates that fall; "expected" does not, for
    `n_samples` times the trajectories.

    scikit-learn's `clone` of a planner has an unfitted model, unless that is in a
    `FrozenEstimator`.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import Cartpole, OneStepRegressor
    >>> from trajlearn.control import MPC
    >>> env = Cartpole()
    >>> model = OneStepRegressor(LinearRegression(), policy=env.policy)
    >>> model.fit(env.collect(10, 50, random_state=0))  # doctest: +ELLIPSIS
    OneStepRegressor(...)
    >>> planner = MPC(
    ...     model, bounds=env.param_bounds, reward=env.reward, horizon=25, n_candidates=50,
    ...     hold=10, random_state=0,
    ... )
    >>> trials = planner.run(env, [[0.5, 0, 0.1, 0], [-0.5, 0, 0.1, 0]], 30)
    >>> trials.lengths, trials.param_names
    (array([30, 30]), ('k_x', 'k_x_dot', 'k_theta', 'k_theta_dot'))
    >>> planner.decisions_[["trial", "step"]].values.tolist()
    [[0, 0], [0, 10], [0, 20], [1, 0], [1, 10], [1, 20]]
    """

    def __init__(
        self,
        model: Any,
        *,
        bounds: ArrayLike,
        reward: Any,
        horizon: int,
        dt: float | None = None,
        policy: Any = None,
        decision: str = "params",
        optimizer: str = "random",
        n_candidates: int = 1000,
        hold: int | str = 1,
        every: int = 1,
        beyond_end: bool = False,
        is_terminal: Any = None,
        terminal_reward: float | None = None,
        risk: str = "mean",
        kappa: float = 1.0,
        n_samples: int = 20,
        constraint: Any = None,
        max_violation: float = 0.05,
        warm_start: bool = True,
        verbose: int = 0,
        random_state: Any = None,
    ) -> None:
        self.model = model
        self.bounds = bounds
        self.reward = reward
        self.horizon = horizon
        self.dt = dt
        self.policy = policy
        self.decision = decision
        self.optimizer = optimizer
        self.n_candidates = n_candidates
        self.hold = hold
        self.every = every
        self.beyond_end = beyond_end
        self.is_terminal = is_terminal
        self.terminal_reward = terminal_reward
        self.risk = risk
        self.kappa = kappa
        self.n_samples = n_samples
        self.constraint = constraint
        self.max_violation = max_violation
        self.warm_start = warm_start
        self.verbose = verbose
        self.random_state = random_state

    def reset(self) -> Self:
        """Begin a new trial: forget the plan, but do not repeat the random numbers.

        Returns
        -------
        self
        """
        if hasattr(self, "_session"):
            self._session.next_trial()
        return self

    def act(self, state: ArrayLike, time: float = 0.0, **settings: Any) -> Floats:
        """The action at the next step of the trial; plans first where `hold` steps have passed.

        Parameters
        ----------
        state : array-like of shape (d_s,)
        time : float, default=0.0
            Time since the trial began, see `plan`.
        **settings
            Further arguments of `plan`: `horizon`, `references`, `context`, `phase`.

        Returns
        -------
        ndarray of shape (d_a,)

        Raises
        ------
        ValueError
            As `plan`, or if there is no policy to turn parameters into actions.
        """
        session = self._started()
        plan = session.plan
        if plan is None or session.held >= self._kept(plan):
            plan = self.plan(state, time=time, **settings)
        if plan.params is not None:
            action = self._controlled(one_state(state), plan.params, time)
        else:
            assert plan.actions is not None  # a plan has one of the two
            action = plan.actions[session.held].copy()
        session.acted()
        return action

    def run(
        self,
        env: "Environment",
        initial_states: ArrayLike,
        length: int,
        *,
        random_state: int | RandomState | None = None,
    ) -> TrajectoryDataset:
        """Drive a simulator, one trial after the other.

        Parameters
        ----------
        env : Environment
        initial_states : array-like of shape (n, d_s) or (d_s,)
            Where the trials start.
        length : int
            Steps of a trial that does not end early.
        random_state : int, RandomState or None, default=None
            Seed of the environment's process noise; None draws it from that of the planner.

        Returns
        -------
        TrajectoryDataset
            As from `env.rollout`, with the parameters in force at each step as params (T, p)
            where they are what is decided; (p,) where none changed during a trial.

        Raises
        ------
        ValueError
            As `plan` and `env.rollout`, or if `dt` is not that of the environment.
        """
        self._check()
        if self.dt is not None and abs(self.dt - env.dt) > 1e-6 * env.dt:
            raise ValueError(
                f"dt = {self.dt:g}, but a step of the environment takes {env.dt:g}: leave dt= out."
            )
        length = whole(length, "length")
        starts = np.asarray(initial_states, dtype=np.float64)
        starts = starts[None] if starts.ndim == 1 else starts
        self._start_session(dt=env.dt, policy=env.policy)
        seeds = np.random.default_rng([self.seed_, 0, 1]).integers(2**31, size=len(starts))
        if random_state is not None:
            seeds = check_random_state(random_state).randint(2**31, size=len(starts))
        parts, thetas = [], []
        with tqdm(total=len(starts) * length, desc="steps", disable=not self.verbose) as bar:
            for start, seed in zip(starts, seeds.tolist(), strict=True):
                episode, theta = self._trial(env, start, length, seed, bar)
                parts.append(episode)
                thetas.append(theta)
        ds = concatenate(*parts)
        if self.decision == "actions":
            return ds
        own = len(env.param_names) == thetas[0].shape[1]
        return assign(ds, params=thetas, param_names=env.param_names if own else None)

    def _trial(
        self, env: "Environment", start: Floats, length: int, seed: int, bar: Any
    ) -> tuple[TrajectoryDataset, Floats]:
        """One episode, and the parameters in force at each of its steps (T, p)."""
        self.reset()
        session = self._session
        in_force: list[Floats] = []

        def policy(states: Floats, params: Floats, times: Floats) -> Floats:
            left = self.horizon if self.beyond_end else min(self.horizon, length - session.step)
            action = self.act(states[0], float(times[0]), horizon=left)
            assert session.plan is not None  # it has acted
            if session.plan.params is not None:
                in_force.append(session.plan.params)
            bar.update()
            return action[None]

        # in one go: a simulator may know more than the state
        episode = env.rollout(start[None], None, length, policy=policy, random_state=seed)
        return episode, np.array(in_force)

    def _controlled(self, state: Floats, params: Floats, time: float) -> Floats:
        policy = self._known_policy() or self._session.policy
        if policy is None:
            raise ValueError(
                "nothing says which actions the parameters mean: give policy= (of the states, the "
                "parameters and the time), or take the parameters from plan(state)."
            )
        actions = np.asarray(policy(state, params[None], np.array([time])), dtype=np.float64)
        if actions.ndim != 2 or len(actions) != 1:
            raise ValueError(
                f"the policy returned actions of shape {actions.shape} for 1 state; expected "
                "(1, d_a)."
            )
        return actions[0]
