"""Search with a model of the dynamics: what it predicts to be best is tried next."""

from contextlib import suppress
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.frozen import FrozenEstimator

from trajlearn._sklearn import HasMethods, Interval, StrOptions
from trajlearn.control._each_once import each_once
from trajlearn.control._futures import predicts_rewards
from trajlearn.control._optimizers import METHODS, maximise
from trajlearn.control._safe_set import best_to_worst, ranked
from trajlearn.control._trials import Trials, warn_of_ends
from trajlearn.control.objective import RISKS, Assessment, PredictedReturn
from trajlearn.control.search import Proposal, Search
from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._members import member_of, n_members
from trajlearn.exceptions import MissingFieldError, NoUncertaintyError, UnsafeProposalError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.rewards import Reward, step_rewards
from trajlearn.trajectories.times import uniform_step

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["PolicySearch"]

Floats = NDArray[np.float64]
# what the random streams of one search are for, beside those of `Search`
_FIT, _PREDICT = 2, 3
# candidates that keep the constraint in some samples and are judged by others, this many times more
_CONFIRMED, _COPIES = 64, 4


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
        Fitted on all trials told before the last proposal or prediction; after `resume` there is
        none until then.
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
        self.model = model
        self.bounds = bounds
        self.reward = reward
        self.horizon = horizon
        self.optimizer = optimizer
        self.n_initial = n_initial
        self.initial_states = initial_states
        self.objective = objective
        self.kappa = kappa
        self.n_samples = n_samples
        self.is_terminal = is_terminal
        self.terminal_reward = terminal_reward
        self.constraint = constraint
        self.max_violation = max_violation
        self.every = every
        self.n_evaluations = n_evaluations
        self.policy = policy
        self.random_state = random_state
        self.verbose = verbose

    def _validate_params(self) -> None:
        super()._validate_params()
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
            ``reward`` (m,), its ``std`` (None if the model gives none), ``violation`` (None
            without `constraint`) and ``value``, what `objective` makes of them.

        Raises
        ------
        ValueError
            If `params` has another shape, or nothing was told that a model could learn from.
        """
        state = self._begun()
        candidates = np.atleast_2d(np.asarray(params, dtype=np.float64))
        if candidates.ndim != 2 or candidates.shape[1] != len(state.bounds):
            raise ValueError(
                f"params has shape {np.shape(params)}; expected (m, {len(state.bounds)})."
            )
        if not np.isfinite(candidates).all():
            raise ValueError("params has NaN or infinite values.")
        seed = int(self._rng(len(state), _PREDICT).integers(2**31))
        with each_once():
            return self._assess(self._fitted(), candidates, seed)

    def _assess(self, model: Any, candidates: Floats, seed: int) -> Assessment:
        """Assessment of few candidates, with a standard deviation if the model gives any."""
        copies = 1 if self.constraint is None else _COPIES
        found = self._objective(model, seed, copies=copies)(candidates)
        if found.std is None:
            try:
                std = self._objective(model, seed, risk="lcb", constrained=False)(candidates).std
            except NoUncertaintyError:
                std = None
            found = Assessment(found.value, found.reward, std, found.violation)
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
        data, settings = state.data, dict[str, Any]()
        price = self.terminal_reward
        price = state.least_reward() if price is None else price
        if self.is_terminal is not None and price is None and not predicts_rewards(model):
            raise ValueError(
                "terminal_reward=None takes the least step reward of all trials, but no reward was "
                "measured in any: give terminal_reward=."
            )
        if data is not None:
            if not _future_known(state):
                raise ValueError(
                    f"no trial ran over the horizon of {state.horizon} steps yet, so the "
                    "references of the next one are unknown: tell one that did."
                )
            whole = np.flatnonzero(data.lengths >= state.horizon)
            last = data[int(whole[-1]) if len(whole) else -1]
            settings = {"dt": uniform_step(data), "state_names": data.state_names}
            settings["start_time"] = float(last.times[0])
            settings["context"] = dict(last.context)
            if last.references is not None:
                settings["references"] = last.references
            if not np.isnan(last.time_origin):
                settings["phase"] = last.times[0] - last.time_origin
        if risk is None:
            risk = "mean" if self.objective == "thompson" else self.objective
        return PredictedReturn(
            model,
            # direct reward models need none
            reward=_unknown if self.reward is None else self.reward,
            horizon=state.horizon,
            initial_states=self._initial_states(data),
            risk=risk,
            kappa=self.kappa,
            n_samples=copies * self.n_samples,
            is_terminal=self.is_terminal,
            terminal_reward=price,
            constraint=self.constraint if constrained else None,
            every=self.every,
            policy=self.policy,
            random_state=seed,
            **settings,
        )

    def _initial_states(self, data: TrajectoryDataset | None) -> Floats:
        if self.initial_states is not None:
            return np.atleast_2d(np.asarray(self.initial_states, dtype=np.float64))
        if data is None:
            raise ValueError("no trial was told, so give initial_states=.")
        first = data.states[data.offsets[:-1]]
        # trials that all begin alike need one prediction
        return first[:1] if (first == first[0]).all() else first

    def _check_trials(self, ds: TrajectoryDataset) -> None:
        if not predicts_rewards(self.model):
            if self.reward is not None:
                # predicted states have an axis more than those of a trial
                with suppress(MissingFieldError):
                    step_rewards(self.reward, ds.states[None, 1:2])
            warn_of_ends(ds, self.is_terminal, self.horizon)
        if self.initial_states is None:
            return
        width = self._initial_states(None).shape[1]
        if width != len(ds.state_names):
            raise ValueError(
                f"the trial has {len(ds.state_names)} states a step, initial_states= has {width}."
            )

    # -- the model ------------------------------------------------------------------------

    def _fitted(self) -> Any:
        """The model fitted on all trials told; `model_` from then on."""
        state = self._told()
        cached = (self.model, state.data, self.terminal_reward)
        if _same(getattr(self, "_fitted_on", ()), cached):
            return self.model_  # type: ignore[has-type]
        if isinstance(self.model, FrozenEstimator):
            model = self.model.estimator
        else:
            model = seeded(self.model, self._rng(len(state), _FIT))
            try:
                model = self._fit(model)
            except Exception as error:
                error.add_note(f"This was in fitting the model on the {len(state)} trial(s) told.")
                raise
        self.model_, self._fitted_on = model, cached
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
        if len(state) < self.n_initial:
            return False
        if not _future_known(state):
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
        )

    def _maximum(self, model: Any, rng: np.random.Generator) -> tuple[Floats, int]:
        """The best params (p,) that the optimiser finds, and a seed to assess them with."""
        seed = int(rng.integers(2**31))
        bounds, judged = self._told().bounds, model
        if self.objective == "thompson":
            size = n_members(model)
            if size < 2:
                raise ValueError(
                    'objective="thompson" draws a member of an ensemble, but the model has one '
                    "only: use an MLPEnsembleRegressor with n_members > 1, or another objective."
                )
            judged = member_of(model, int(rng.integers(size)))
        settings: dict[str, Any] = {
            "n_evaluations": self.n_evaluations,
            "rng": rng,
            "start": self._start_points(),
        }
        method = self.optimizer
        if method == "gradient":
            from trajlearn.control._gradient import ascend

            objective = self._objective(judged, seed, constrained=False)
            found = ascend(objective, bounds, **settings).params
            if self.constraint is None or self._keeps(model, seed, found):
                return found, seed
            # a share of trajectories has no gradient: go on without
            method, known = "cma", settings["start"]
            settings["start"] = found[None] if known is None else np.vstack([found, known])
        if self.constraint is None:
            objective = self._objective(judged, seed)
            best = maximise(
                lambda params: objective(params).value, bounds, method=method, **settings
            )
            return best.params, seed
        # a crash is judged by all members
        own = None if judged is model else self._objective(judged, seed, constrained=False)
        rank = self._ranking(model, seed, own)
        tried: list[tuple[Floats, Floats]] = []
        maximise(
            rank, bounds, method=method, on_batch=lambda *batch: tried.append(batch), **settings
        )
        # judged again, by other and more samples
        chosen, before = best_to_worst(tried, _CONFIRMED)
        seed = int(rng.integers(2**31))
        again = self._ranking(model, seed, own, copies=_COPIES)(chosen)
        return chosen[int(np.argmax(np.minimum(before, again)))], seed

    def _ranking(
        self, model: Any, seed: int, own: PredictedReturn | None, *, copies: int = 1
    ) -> "Callable[[Floats], Floats]":
        """Values of candidates, those that violate the constraint too often below all others."""
        guard = self._objective(model, seed, copies=copies)

        def rank(params: Floats) -> Floats:
            found = guard(params)
            wanted = found.value if own is None else own(params).value
            return ranked(wanted, found.violation, self.max_violation)

        return rank

    def _keeps(self, model: Any, seed: int, params: Floats) -> bool:
        violation = self._objective(model, seed, copies=_COPIES)(params[None]).violation
        return violation is None or bool(violation[0] <= self.max_violation)

    def _start_points(self) -> Floats | None:
        """The best params tried and the last ones proposed, inside the bounds (k, p)."""
        state, (params, returns) = self._told(), self._tried()
        points = [params[int(np.argmax(returns))]] if len(returns) else []
        points += [] if state.last is None else [state.last]
        if not points:
            return None
        return np.clip(np.unique(points, axis=0), *state.bounds.T)


def _future_known(state: Trials) -> bool:
    """Whether the references of the next trial are known, if it has any."""
    data = state.data
    return data is None or data.references is None or bool(data.lengths.max() >= state.horizon)


def _unknown(states: Floats) -> Floats:
    return np.full(states.shape[:-1], np.nan)


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True))
