"""Our forecasters in a regime: each member by itself, and the selector that chooses among them."""

import time
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.model_selection import GroupKFold

from benchmarks.paper._rollouts import expected_warnings
from benchmarks.regimes._episodes import Episodes, episodes
from benchmarks.regimes._regimes import REGIMES, Regime
from benchmarks.regimes._scores import scores
from trajlearn import (
    Forecast,
    HorizonSelector,
    OneStepRegressor,
    TrajectoryDataset,
    default_members,
)
from trajlearn.dynamics._selection.default_members import clipped_to
from trajlearn.dynamics._selection.entrant import policy_for_held_out
from trajlearn.dynamics._selection.joint_folds import FoldFits
from trajlearn.regressors import polynomial
from trajlearn.regressors.control_law import ControlLawRegressor

Ints = NDArray[np.intp]
Members = list[tuple[str, Any]]

RULES = ("pick", "blend")
N_FOLDS = 4
#: Gradient steps of a network in quick mode, and its members.
QUICK_STEPS = 400
QUICK = ("poly1", "poly3", "poly1_em", "poly3_em", "network", "C", "T")


def members_of(regime: Regime, ds: TrajectoryDataset, policy: Any, mode: str) -> Members:
    """The selector's default members, and those that the regime calls for.

    With a cloned policy if there is to be one: the known one can take its place in any forecast,
    so that one fit serves both.
    """
    if "unknown" in regime.policies:
        policy = "clone"
    members = default_members(ds, policy=policy, partial=bool(regime.states))
    if regime.acts_on_noise:
        sees = OneStepRegressor(
            polynomial(degree=1),
            policy=policy,
            clip_states=clipped_to(len(ds)),
            denoise="em",
            policy_sees="measurements",
        )
        members.append(("poly1_em_sees", sees))
    laws = Laws()
    for _, model in members:
        if getattr(model, "policy", None) == "clone":
            model.set_params(policy_estimator=OnceFitted(laws))
    if mode == "quick":
        members = [(name, model) for name, model in members if name in QUICK]
        for name, model in members:
            if name in ("network", "C", "T"):
                model.set_params(estimator__max_steps=QUICK_STEPS)
    return members


class Laws(dict[str, ControlLawRegressor]):
    """Controllers that were learned, by what from; copies of estimators share it."""

    def __deepcopy__(self, memo: Any) -> "Laws":
        return self


class OnceFitted(ControlLawRegressor):
    """The default learner of a policy, which fits the same rows once for all members."""

    def __init__(self, laws: Laws, *, random_state: int = 0) -> None:
        super().__init__(random_state=random_state)
        self.laws = laws

    def fit(
        self, X: Any, y: Any, *, sample_weight: Any = None, groups: Any = None, gains: Any = None
    ) -> "OnceFitted":
        """Fit, or take over what was fitted."""
        given = {"sample_weight": sample_weight, "groups": groups, "gains": gains}
        key = joblib.hash((X, y, given, self.random_state))
        if key not in self.laws:
            law = ControlLawRegressor(random_state=self.random_state)
            self.laws[key] = law.fit(X, y, **given)
        vars(self).update(vars(self.laws[key]))
        return self


class HeldOut(BaseEstimator):
    """A fitted member that answers for held-out episodes by the model that has not seen them.

    It lets a selector judge members that were fitted before, under one policy and another; it is
    its own clone, and takes no time to fit.

    Parameters
    ----------
    model : estimator
        Fitted on all episodes.
    forecasts : dict from tuple of ids to Forecast
        Of the episodes that each fold holds out.
    policy : callable or None
        Of its roll-outs; None is what it was fitted with.
    """

    def __init__(
        self, model: Any, forecasts: dict[tuple[Any, ...], Forecast], policy: Any = None
    ) -> None:
        self.model = model
        self.forecasts = forecasts
        self.policy = policy

    def fit(self, X: Any, y: None = None) -> "HeldOut":
        """Do nothing: it is fitted."""
        return self

    def __sklearn_clone__(self) -> "HeldOut":
        return self

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def predict(self, ds: TrajectoryDataset, return_std: bool = False, **asked: Any) -> Forecast:
        """Forecast of held-out episodes as recorded, of others by the model of all."""
        known = self.forecasts.get(tuple(ds.ids.tolist()))
        if known is not None and not return_std:
            return known
        if asked.get("policy") is None:
            asked["policy"] = self.policy
        return self.model.predict(ds, return_std=return_std, **asked)


def folds_of(ds: TrajectoryDataset, seed: int) -> list[tuple[Ints, Ints]]:
    """Training and held-out episodes, as the selector's own: up to five are left out singly."""
    units = np.arange(len(ds)) if ds.group is None else ds.group
    n_units = len(np.unique(units))
    n_folds = n_units if n_units <= 5 else N_FOLDS
    splitter = GroupKFold(n_folds, shuffle=True, random_state=seed)
    return list(splitter.split(ds.lengths, groups=units))


def cell(system: str, regime: str, mode: str, seed: int) -> dict[str, Any]:
    """Fit every member once, and judge it and the selectors over them on the test episodes.

    Returns
    -------
    dict
        ``policies``: of each, ``models`` (name to `scores`, the rules among them), ``choice``
        (of the rule "pick": first horizon and member of each stretch) and ``best``;
        ``fit_seconds``: of all fits of a member, CPU; ``noise``: by denoised member, whether
        noise was ``found``, its ``std`` and the ``true`` one, in ranges of each state.
    """
    what = REGIMES[system, regime]
    data = episodes(what, seed, mode)
    folds = folds_of(data.train, seed)
    rng = np.random.default_rng([seed, 11])
    fitted, seconds, noise = {}, {}, {}
    for name, member in members_of(what, data.train, data.policy, mode):
        began = time.process_time()
        with expected_warnings():
            fits = FoldFits(member, data.train, folds, rng=rng)
            models = fits.fit(range(len(folds)), whole=True)
        fitted[name] = models, fits.model
        seconds[name] = time.process_time() - began
        model = fitted[name][1]
        if getattr(model, "denoise", None) is not None:
            found = model.measurement_noise_ / data.span
            true = data.noise / data.span
            noise[name] = {"found": bool(model.noisy_), "std": found, "true": true}
    return {
        "policies": {
            policy: judged(fitted, folds, data, data.policy if policy == "known" else None)
            for policy in what.policies
        },
        "fit_seconds": seconds,
        "noise": noise,
    }


def judged(
    fitted: dict[str, tuple[list[Any], Any]],
    folds: list[tuple[Ints, Ints]],
    data: Episodes,
    policy: Any,
) -> dict[str, Any]:
    """Errors of fitted members, and of the selectors over them, under one policy."""
    members = {
        name: HeldOut(model, recorded(models, model, folds, data.train, policy), policy)
        for name, (models, model) in fitted.items()
    }
    found: dict[str, Any] = {"models": {}}
    for name, member in members.items():
        found["models"][name] = _scores(member, data)
    for rule in RULES:
        selector = HorizonSelector(list(members.items()), cv=folds, rule=rule, random_state=0)
        selector.fit(data.train)
        found["models"][rule] = _scores(selector, data)
        if rule == "pick":
            found |= {"best": selector.best_, "choice": _stretches(selector.choice_)}
    return found


def recorded(
    models: list[Any],
    whole: Any,
    folds: list[tuple[Ints, Ints]],
    ds: TrajectoryDataset,
    policy: Any,
) -> dict[tuple[Any, ...], Forecast]:
    """Forecasts of what each fold holds out, by ids of episodes; `whole` is fitted on all."""
    found = {}
    if policy is None:
        policy = policy_for_held_out(whole, ds)
    for model, (_, test) in zip(models, folds, strict=True):
        some = ds[test]
        with expected_warnings():
            found[tuple(some.ids.tolist())] = model.predict(some, policy=policy, random_state=0)
    return found


def _scores(model: Any, data: Episodes) -> dict[str, Any]:
    with expected_warnings():
        return scores(model.predict(data.test, random_state=0).mean, data)


def _stretches(choice: NDArray[np.str_]) -> list[list[Any]]:
    """First horizon and name of each stretch of the same choice."""
    begin = np.flatnonzero(np.r_[True, choice[1:] != choice[:-1]])
    return [[int(i) + 1, str(choice[i])] for i in begin]
