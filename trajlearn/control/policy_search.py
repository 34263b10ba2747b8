"""Search with a model of the dynamics: what it predicts to be best is tried next."""

from contextlib import suppress
from dataclasses import replace
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.frozen import FrozenEstimator

from trajlearn._sklearn import HasMethods, Interval, StrOptions
from trajlearn.control._best_params import COPIES, Goal, best_params
from trajlearn.control._each_once import each_once
from trajlearn.control._futures import predicts_rewards
from trajlearn.control._next_trial import first_states, future_known, signals_of
from trajlearn.control._optimizers import METHODS
from trajlearn.control._trial_returns import warn_of_ends
from trajlearn.control._trials import Trials
from trajlearn.control.objective import RISKS, Assessment, PredictedReturn
from trajlearn.control.search import Proposal, Search
from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._members import member_of, n_members
from trajlearn.exceptions import MissingFieldError, NoUncertaintyError, UnsafeProposalError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.rewards import Reward, step_rewards

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["PolicySearch"]

Floats = NDArray[np.float64]
# what the random streams of one search are for, beside those of `Search`
_FIT, _PREDICT = 2, 3


class PolicySearch(Search):
    """Tune a controller in few trials: a model learns from all of them and proposes the next.

    After each trial the model is fitted anew on all trials told; the parameters whose predicted
    return is greatest are tried next.

    Parameters
    ----------
    model : dynamics estimator, direct reward model, or Pipeline
        Anything that predicts trajectories from first states and params (one-step models with a
        policy), or the return itself. It is cloned before it is fitted; a
        `sklearn.frozen.FrozenEstimator` of a fitted model is taken as it is.
    bounds : array-like of shape (p, 2)
        Lowest and highest value of each parameter.
    reward : callable or None
        ``reward(states)`` of the states each step leads into, vectorised; None takes the logged
        rewards, for direct reward models only.
    horizon : int
        Steps of a trial.
    optimizer : {"cma", "cem", "random", "gradient"}, default="cma"
        How the predicted return is maximised: CMA-ES, the cross-entropy method, uniform draws,
        or the gradient of a `TrajectoryRegressor` in theta, from many starts at once.
        ``"gradient"`` is for the objectives "mean" and "thompson".
    n_initial : int, default=1
        Trials told before the model proposes; until then a scrambled Sobol sequence does. 0 is
        possible with a frozen model and `initial_states`.
    initial_states : array-like of shape (d_s,) or (n0, d_s), optional
        First states over which the predicted return is averaged. Default: those of all trials.
    objective : {"mean", "expected", "lcb", "thompson"}, default="mean"
        What is maximised: the return of the mean trajectory; the mean return of sampled
        trajectories; their lower confidence bound ``expected - kappa * std``; or the return of
        the mean trajectory of one ensemble member, drawn anew for each proposal. Choose
        "expected" where trials may go either way, see the Notes.
    kappa : float, default=1.0
        Standard deviations that ``"lcb"`` subtracts; with 0 it is ``"expected"``.
    n_samples : int, default=20
        Sampled trajectories a candidate, where ``"expected"``, a standard deviation or a
        violation needs them; what is proposed under a `constraint` is confirmed by four times as
        many others.
    is_terminal : callable, optional
        ``is_terminal(states) -> bool``: where a predicted trial ends early.
    terminal_reward : float, optional
        What each step after an early termination is worth, in trials and in predictions. None:
        the least step reward in any trial told, so that crashing never pays.
    constraint : callable, optional
        ``constraint(states (..., d_s)) -> bool``, True where the state is allowed.
    max_violation : float, default=0.05
        Greatest predicted probability that a trial leaves the constraint, for it to be proposed.
        The first `n_initial` trials are chosen without a model, hence without this guard.
    every : int, default=1
        Evaluate each `every`-th step of a predicted trial only and interpolate the rewards.
    n_evaluations : int, default=1000
        Candidates that the optimiser may assess for one proposal.
    policy : callable, optional
        Controller for one-step models and for `run`, if it is not the system's own.
    random_state : int, RandomState or None, default=None
    verbose : int, default=0
        A progress bar in `run`.

    Attributes
    ----------
    model_ : estimator
        Fitted on all trials told before the last proposal or prediction; at the first look, on
        all trials, if there was none, as after `resume`.
    trials_ : TrajectoryDataset
    returns_ : ndarray of shape (n,)
    best_params_ : ndarray of shape (p,)
    best_reward_ : float
    seed_ : int

    See Also
    --------
    BayesianSearch : models the return alone.
    RandomSearch : no model.
    PredictedReturn : what is maximised.

    Notes
    -----
    The return of the mean trajectory, ``objective="mean"``, costs least, and is right where the
    model is sure of where a trial goes. Where an unstable plant may fall to either side, the mean
    of both stays upright: "mean" then over-rates controllers that fall, and "expected" does not.

    The next trial is taken to be like the last that ran over the whole horizon: with its
    references, context, phase and start time. Where trials have references and none ran that long
    yet, what they would have been is unknown, and Sobol points are asked for.

    Examples
    --------
    A plant ``s' = s + a`` under ``a = -k s``: trials of two gains tell the model how it works,
    and the third has the best gain.

    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import OneStepRegressor, Trajectory
    >>> from trajlearn.control import PolicySearch
    >>> def cost(states):
    ...     return -states[..., 0] ** 2
    >>> search = PolicySearch(
    ...     OneStepRegressor(LinearRegression(), policy=lambda s, theta, t: -theta * s),
    ...     bounds=[[0.0, 2.0]], reward=cost, horizon=5, n_initial=2, n_evaluations=200,
    ...     random_state=0,
    ... )
    >>> for _ in range(3):
    ...     gain = search.ask()
    ...     states = (1 - gain) ** np.arange(6)[:, None]
    ...     search = search.tell(Trajectory(states, actions=-gain * states[:-1], params=gain))
    >>> search.best_params_.round(2)
    array([1.])
    """

    # a fitted model, and what it was fitted on
    _last_fit: tuple[Any, tuple[Any, ...]] | None = None

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **Search._parameter_constraints,
        "model": [HasMethods(["fit", "predict"])],
        "optimizer": [StrOptions({*METHODS, "gradient"})],
        "n_initial": [Interval(Integral, 0, None, closed="left")],
        "initial_states": ["array-like", None],
        "objective": [StrOptions({*RISKS, "thompson"})],
        "kappa": [Interval(Real, 0, None, closed="left")],
        "n_samples": [Interval(Integral, 1, None, closed="left")],
        "is_terminal": [callable, None],
        "constraint": [callable, None],
        "max_violation": [Interval(Real, 0, 1, closed="both")],
        "every": [Interval(Integral, 1, None, closed="left")],
        "n_evaluations": [Interval(Integral, 1, None, closed="left")],
        "policy": [callable, None],
    }

    def __init__(
        self,
        model: Any,
        *,
        bounds: ArrayLike,
        reward: Reward | None,
        horizon: int,
        optimizer: str = "cma",
        n_initial: int = 1,
        initial_states: ArrayLike | None = None,
        objective: str = "mean",
        kappa: float = 1.0,
        n_samples: int = 20,
        is_terminal: "Callable[..., Any] | None" = None,
        terminal_reward: float | None = None,
        constraint: "Callable[..., Any] | None" = None,
        max_violation: float = 0.05,
        every: int = 1,
        n_evaluations: int = 1000,
        policy: Any = None,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(
            bounds=bounds,
            reward=reward,
            horizon=horizon,
            terminal_reward=terminal_reward,
            random_state=random_state,
            verbose=verbose,
        )
        self.model = model
        self.optimizer = optimizer
        self.n_initial = n_initial
        self.initial_states = initial_states
        self.objective = objective
        self.kappa = kappa
        self.n_samples = n_samples
        self.is_terminal = is_terminal
        self.constraint = constraint
        self.max_violation = max_violation
        self.every = every
        self.n_evaluations = n_evaluations
        self.policy = policy

    def _validate_params(self) -> None:
        super()._validate_params()
        if isinstance(self.model, type):
            name = self.model.__name__
            raise ValueError(f"model = {name} is a class: give an estimator, model = {name}(...).")
        if self.optimizer == "gradient" and self.objective in ("expected", "lcb"):
            # said before a trial is run
            raise ValueError(
                f"optimizer='gradient' cannot follow objective={self.objective!r}, which is "
                "computed from sampled trajectories: choose another optimizer, or 'mean' or "
                "'thompson'."
            )

    # -- predictions ----------------------------------------------------------------------

    def predict_return(self, params: ArrayLike) -> Assessment:
        """What the current model says about parameters; it is fitted first if need be.

        Parameters
        ----------
        params : array-like of shape (m, p) or (p,)

        Returns
        -------
        Assessment
            ``reward`` (m,), of the mean trajectories with the objectives "mean" and "thompson";
            ``expected``, the mean return, and ``std`` (None if the model gives none);
            ``violation`` (None without `constraint`) and ``value``, what `objective` makes of
            them.

        Raises
        ------
        ValueError
            If `params` has another shape, or nothing was told that a model could learn from.
        """
        candidates = self._candidates(params)
        seed = int(self._rng(len(self._told()), _PREDICT).integers(2**31))
        with each_once():
            return self._assess(self._fitted(), candidates, seed)

    def _assess(self, model: Any, candidates: Floats, seed: int) -> Assessment:
        """Assessment of few candidates, with a standard deviation if the model gives any."""
        copies = 1 if self.constraint is None else COPIES
        found = self._objective(model, seed, copies=copies)(candidates)
        if found.std is None:
            with suppress(NoUncertaintyError):
                drawn = self._objective(model, seed, risk="lcb", constrained=False)(candidates)
                found = replace(found, expected=drawn.expected, std=drawn.std)
        return found

    def _objective(
        self,
        model: Any,
        seed: int,
        *,
        risk: str | None = None,
        constrained: bool = True,
        copies: int = 1,
    ) -> PredictedReturn:
        state = self._told()
        price = self.terminal_reward
        price = state.least_reward() if price is None else price
        if self.is_terminal is not None and price is None and not predicts_rewards(model):
            raise ValueError(
                "terminal_reward=None takes the least step reward of all trials, but no reward was "
                "measured in any: give terminal_reward=."
            )
        if risk is None:
            risk = "mean" if self.objective == "thompson" else self.objective
        return PredictedReturn(
            model,
            # direct reward models need none
            reward=_unknown if self.reward is None else self.reward,
            horizon=state.horizon,
            initial_states=first_states(state.data, self.initial_states),
            risk=risk,
            kappa=self.kappa,
            n_samples=copies * self.n_samples,
            is_terminal=self.is_terminal,
            terminal_reward=price,
            constraint=self.constraint if constrained else None,
            every=self.every,
            policy=self.policy,
            random_state=seed,
            **signals_of(state),
        )

    def _check_trials(self, ds: TrajectoryDataset) -> None:
        if not predicts_rewards(self.model):
            if self.reward is not None:
                # predicted states have an axis more than those of a trial
                with suppress(MissingFieldError):
                    step_rewards(self.reward, ds.states[None, 1:2])
            warn_of_ends(ds, self.is_terminal, self.horizon)
        if self.initial_states is None:
            return
        width = first_states(None, self.initial_states).shape[1]
        if width != len(ds.state_names):
            raise ValueError(
                f"the trial has {len(ds.state_names)} states a step, initial_states= has {width}."
            )

    # -- the model ------------------------------------------------------------------------

    @property
    def model_(self) -> Any:
        """The model behind the last proposal or prediction; fitted on all trials if there is none.

        As after `resume`.
        """
        if self._last_fit is None:
            # raises unless something was told, or the model was fitted before
            if not isinstance(self.model, FrozenEstimator):
                _ = self.trials_
            self._begun()
            return self._fitted()
        return self._last_fit[0]

    def _go_on(self, state: Trials) -> None:
        if state is not self._state:
            self._last_fit = None
        super()._go_on(state)

    def _fitted(self) -> Any:
        """The model fitted on all trials told; `model_` from then on."""
        state = self._told()
        key = (self.model, state.data, self.terminal_reward)
        if self._last_fit is not None and _same(self._last_fit[1], key):
            return self._last_fit[0]
        if isinstance(self.model, FrozenEstimator):
            model = self.model.estimator
        else:
            model = seeded(self.model, self._rng(len(state), _FIT))
            try:
                model = self._fit(model)
            except Exception as error:
                error.add_note(f"This was in fitting the model on the {len(state)} trial(s) told.")
                raise
        self._last_fit = model, key
        return model

    def _fit(self, model: Any) -> Any:
        data = self._told().data
        if data is None:
            raise ValueError("no trial was told that the model could learn from.")
        if not predicts_rewards(model):
            if self.reward is None:
                raise ValueError(
                    "reward=None (the logged rewards) is for direct reward models; to judge "
                    f"predicted trajectories of {type(model).__name__}, give reward=."
                )
            return model.fit(data)
        first, returns = data.states[data.offsets[:-1]], self.returns_
        known = ~np.isnan(returns)
        return model.fit(
            np.concatenate([first[known], self._tried()[0]], axis=1), returns[known] / self.horizon
        )

    def _ready(self) -> bool:
        state = self._told()
        if len(state) < self.n_initial or not future_known(state):
            return False
        if isinstance(self.model, FrozenEstimator):
            return True
        return len(self._tried()[1] if predicts_rewards(self.model) else self.returns_) > 0

    # -- proposals ------------------------------------------------------------------------

    def _propose(self, rng: np.random.Generator) -> Proposal:
        with each_once():
            model = self._fitted()
            params, seed = self._maximum(model, rng)
            found = self._assess(model, params[None], seed)
        violation = None if found.violation is None else float(found.violation[0])
        if violation is not None and not violation <= self.max_violation:
            raise UnsafeProposalError(
                f"the least probability of leaving the constraint that was found is "
                f"{violation:.3g}, above max_violation = {self.max_violation:g}: tell more trials "
                "near the allowed states, raise n_evaluations= or max_violation=, or widen "
                "bounds=; perhaps no parameters keep the constraint."
            )
        return Proposal(
            params,
            reward=float(found.reward[0]),
            std=None if found.std is None else float(found.std[0]),
            violation=violation,
            source="model",
            expected=None if found.expected is None else float(found.expected[0]),
        )

    def _maximum(self, model: Any, rng: np.random.Generator) -> tuple[Floats, int]:
        """The best params (p,) that the optimiser finds, and a seed to assess them with."""
        seed = int(rng.integers(2**31))
        judged = model
        if self.objective == "thompson":
            size = n_members(model)
            if size < 2:
                raise ValueError(
                    'objective="thompson" draws a member of an ensemble, but the model has one '
                    "only: use an MLPEnsembleRegressor with n_members > 1, or another objective."
                )
            judged = member_of(model, int(rng.integers(size)))
        limit = None if self.constraint is None else self.max_violation
        return best_params(
            Goal(self._objective, model, judged, limit),
            self._told().bounds,
            seed=seed,
            optimizer=self.optimizer,
            n_evaluations=self.n_evaluations,
            rng=rng,
            start=self._start_points(),
        )

    def _start_points(self) -> Floats | None:
        """The best params tried and the last ones proposed, inside the bounds (k, p)."""
        state, (params, returns) = self._told(), self._tried()
        points = [params[int(np.argmax(returns))]] if len(returns) else []
        points += [] if state.last is None else [state.last]
        if not points:
            return None
        return np.clip(np.unique(points, axis=0), *state.bounds.T)


def _unknown(states: Floats) -> Floats:
    return np.full(states.shape[:-1], np.nan)


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True))
