"""A single decision: candidates, their predicted returns, the best of them."""

import time as clock
import warnings
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.control._decisions import Plan, Session
from trajlearn.control._futures import policy_of
from trajlearn.control._objective_checks import check_width, whole
from trajlearn.control._optimizers import METHODS, checked_bounds, maximise
from trajlearn.control._safe_set import Guarded
from trajlearn.control.objective import RISKS, PredictedReturn
from trajlearn.dynamics._members import unwrapped
from trajlearn.exceptions import CalibrationWarning, HorizonWarning

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Planner", "one_state"]

Floats = NDArray[np.float64]


class Planner(BaseEstimator):
    """What `MPC` decides, and how; the parameters are explained there."""

    model: Any
    bounds: ArrayLike
    reward: Any
    horizon: int
    dt: float | None
    policy: Any
    decision: str
    optimizer: str
    n_candidates: int
    hold: int | str
    every: int
    beyond_end: bool
    is_terminal: Any
    terminal_reward: float | None
    risk: str
    kappa: float
    n_samples: int
    constraint: Any
    max_violation: float
    warm_start: bool
    verbose: int
    random_state: Any

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "bounds": ["array-like"],
        "reward": [callable],
        "horizon": [Interval(Integral, 1, None, closed="left")],
        "dt": [Interval(Real, 0, None, closed="neither"), None],
        "policy": [callable, None],
        "decision": [StrOptions({"params", "actions"})],
        "optimizer": [StrOptions(set(METHODS))],
        "n_candidates": [Interval(Integral, 1, None, closed="left")],
        "hold": [Interval(Integral, 1, None, closed="left"), StrOptions({"all"})],
        "every": [Interval(Integral, 1, None, closed="left")],
        "beyond_end": ["boolean"],
        "is_terminal": [callable, None],
        "terminal_reward": [Real, None],
        "risk": [StrOptions(set(RISKS))],
        "kappa": [Interval(Real, 0, None, closed="left")],
        "n_samples": [Interval(Integral, 2, None, closed="left")],
        "constraint": [callable, None],
        "max_violation": [Interval(Real, 0, 1, closed="left")],
        "warm_start": ["boolean"],
        "verbose": ["verbose"],
        "random_state": ["random_state"],
    }

    @property
    def decisions_(self) -> "pd.DataFrame":
        """One row a decision."""
        if not hasattr(self, "_session"):
            raise AttributeError("nothing was decided yet: call run, act or plan.")
        return self._session.table()

    def plan(
        self,
        state: ArrayLike,
        *,
        time: float = 0.0,
        horizon: int | None = None,
        references: Any = None,
        context: Any = None,
        phase: Any = None,
    ) -> Plan:
        """Decide what to do from a state on.

        Parameters
        ----------
        state : array-like of shape (d_s,)
        time : float, default=0.0
            Time since the trial began, from which a policy or references that depend on it count.
        horizon : int or None, default=None
            Steps to plan ahead; None: as in the constructor.
        references, context, phase
            As in `predict_trajectory` of the model, for one episode.

        Returns
        -------
        Plan

        Raises
        ------
        NotFittedError
            If the model is not fitted.
        ValueError
            If the state, the bounds or a parameter is not as described, the model cannot be
            planned with, or the reward is NaN.
        """
        begin = clock.perf_counter()
        self._check()
        session = self._started()
        n_steps = whole(self.horizon if horizon is None else horizon, "horizon")
        box = checked_bounds(self.bounds)
        shape = (len(box),) if self.decision == "params" else (n_steps, len(box))
        box = np.tile(box, (n_steps, 1)) if self.decision == "actions" else box
        rng = np.random.default_rng([self.seed_, len(session.rows)])
        # built anew in a hundredth of the time of a decision, whose horizon, clock, references
        # and samples are its own
        assess = PredictedReturn(
            self.model,
            reward=self.reward,
            horizon=n_steps,
            dt=session.dt if self.dt is None else self.dt,
            initial_states=one_state(state),
            risk=self.risk,
            kappa=self.kappa,
            n_samples=self.n_samples,
            is_terminal=self.is_terminal,
            terminal_reward=self.terminal_reward,
            constraint=self.constraint,
            every=min(self.every, n_steps),
            decision=self.decision,
            policy=self.policy,
            references=references,
            context=context,
            phase=phase,
            start_time=time,
            random_state=int(rng.integers(2**31)),
        )
        start, warm = self._start(self._before(session, shape), box, rng)
        guarded = Guarded(assess, self.max_violation, shape)
        with warnings.catch_warnings():
            if session.rows:
                # what holds of all decisions alike is said once
                warnings.simplefilter("ignore", HorizonWarning)
                warnings.simplefilter("ignore", CalibrationWarning)
            found = maximise(
                guarded,
                box,
                method=self.optimizer,
                n_evaluations=self.n_candidates,
                rng=rng,
                start=start,
                begin=warm,
            )
        if guarded.best is None:
            raise ValueError(
                f"none of {found.n_evaluations} candidates has a finite predicted return: look at "
                "the reward, terminal_reward= and the bounds."
            )
        best = guarded.best.reshape(shape)
        plan = Plan(
            params=best if self.decision == "params" else None,
            actions=best if self.decision == "actions" else None,
            value=guarded.value,
            violation=guarded.violation,
            seconds=clock.perf_counter() - begin,
            n_candidates=found.n_evaluations,
        )
        session.decided(plan)
        return plan

    def _start(
        self, before: Floats | None, box: Floats, rng: np.random.Generator
    ) -> tuple[Floats | None, Floats | None]:
        """`start` and `begin` of `maximise`: the decision before, and all random candidates.

        They are in one batch, as a roll-out of one takes hardly less time than that of many.
        """
        warm = None if before is None else np.clip(before, *box.T)
        if self.optimizer != "random":
            return None, warm
        n_fresh = self.n_candidates - (warm is not None)
        fresh = rng.uniform(box[:, 0], box[:, 1], size=(n_fresh, len(box)))
        return fresh if warm is None else np.concatenate([warm[None], fresh]), None

    def _before(self, session: Session, shape: tuple[int, ...]) -> Floats | None:
        """The decision before as a candidate (d,): actions moved on, the last one repeated."""
        plan = session.plan if self.warm_start else None
        if plan is None:
            return None
        values = plan.params if self.decision == "params" else plan.actions
        if values is None or values.shape[-1] != shape[-1]:
            # something else was decided
            return None
        if self.decision == "actions":
            passed = session.held or min(self._hold(), len(values))
            ahead = int(passed) + np.arange(shape[0])
            values = values[np.minimum(ahead, len(values) - 1)]
        return values.ravel()

    # -- state and checks -----------------------------------------------------------------

    def _started(self) -> Session:
        """The session that goes on, or a new one."""
        if not hasattr(self, "_session"):
            self._start_session()
        return self._session

    def _start_session(self, **where: Any) -> None:
        self.seed_ = int(check_random_state(self.random_state).randint(2**31))
        self._session = Session(**where)

    def _hold(self) -> float:
        return np.inf if self.hold == "all" else float(self.hold)

    def _kept(self, plan: Plan) -> float:
        """Steps for which a plan is followed."""
        return self._hold() if plan.actions is None else min(self._hold(), len(plan.actions))

    def _known_policy(self) -> Any:
        """The policy that is given, or that of the model."""
        return policy_of(self.model, self.policy)

    def _check(self) -> None:
        """Check the parameters, and whether the model can be planned with."""
        self._validate_params()
        if hasattr(self.model, "fit"):
            check_is_fitted(self.model)
        check_width(self.model, self.decision, checked_bounds(self.bounds))
        blocks = getattr(unwrapped(self.model), "layout_", None)
        name = type(unwrapped(self.model)).__name__
        if self.decision == "actions":
            if self.horizon < self._hold() < np.inf:
                raise ValueError(
                    f"hold = {self.hold} is more than the horizon = {self.horizon} actions that "
                    "are planned: hold no longer, or plan further."
                )
        elif blocks is not None and "action" in blocks and self._known_policy() is None:
            raise ValueError(
                f"decision='params' with a {name} that takes actions needs policy=, which turns "
                "states and params into actions; or plan over actions."
            )


def one_state(state: ArrayLike) -> Floats:
    """A state as an array (1, d_s).

    Raises
    ------
    ValueError
        If it is no vector, or not finite.
    """
    array = np.asarray(state, dtype=np.float64)
    if array.ndim != 1:
        raise ValueError(f"state has shape {array.shape}; expected (d_s,), one state.")
    if not np.isfinite(array).all():
        raise ValueError("state has NaN or infinite values.")
    return array[None]
