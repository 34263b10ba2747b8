"""The models of all folds and that of all episodes, trained together where the learner allows."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from tqdm import tqdm

from trajlearn.dynamics._dynamics import DynamicsEstimator
from trajlearn.dynamics._learner import seeded
from trajlearn.regressors._joint import Job, can_join, fit_jointly
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["FoldFits"]

Ints = NDArray[np.intp]
# fits an unfitted model
_Fit = Callable[[Any], Any]


class FoldFits:
    """Fits an estimator on the training episodes of folds, now or later, and on all episodes.

    A dynamics estimator over an `MLPEnsembleRegressor` trains the networks of all that is asked for
    at once as one, see `trajlearn.regressors._joint`: those of the folds take as many steps as that
    of all episodes. Anything else is fitted one by one.

    An estimator with ``denoise="em"`` or ``latent_velocities=True`` smooths all episodes once, and
    the models of the folds are fitted on smoothed episodes and take over the noise: held-out
    episodes have a say in the states that their models are trained on, through the smoother alone.

    Parameters
    ----------
    estimator : estimator
        Unfitted; it is cloned.
    ds : TrajectoryDataset
    folds : sequence of (train, test)
        Indices of episodes.
    rng : Generator
        Of the seeds that `estimator` leaves open; all fits have the same.
    std : bool, default=True
        False: only means are asked of the models of the folds, whose networks then do without a
        separate variance. Their means are the same, and the folds take a seventh less time.

    Attributes
    ----------
    model : estimator or None
        Of all episodes, once it is fitted.
    """

    def __init__(
        self,
        estimator: Any,
        ds: TrajectoryDataset,
        folds: Sequence[tuple[Ints, Ints]],
        *,
        rng: np.random.Generator,
        std: bool = True,
    ) -> None:
        self._unfitted = seeded(estimator, rng)
        self._ds, self._folds, self._std = ds, folds, std
        self._smoothed: tuple[TrajectoryDataset, Any] | None = None
        self.model: Any = None

    def fit(
        self,
        which: Sequence[int],
        *,
        whole: bool,
        policies: Mapping[int, Any] = MappingProxyType({}),
        verbose: int = 0,
    ) -> list[Any]:
        """Models of some folds.

        Parameters
        ----------
        which : sequence of int
        whole : bool
            Whether `model` is wanted now. What smooths episodes comes first of all in any case.
        policies : mapping from int to ClonedPolicy
            By fold, and by the number of folds for all episodes: what ``policy="clone"`` would
            learn there, if it is known already.
        verbose : int, default=0
        """
        if self.model is None and _denoises(self._unfitted):
            self._smooth()
        fits = [self._on(k, policies) for k in which]
        every = self._on(len(self._folds), policies)
        plain = 0 if self._std else len(fits)
        if self.model is None and whole:
            *models, self.model = _fit_all(self._unfitted, [*fits, every], plain, verbose)
            return models
        return _fit_all(self._unfitted, fits, plain, verbose, as_long_as=every)

    def _smooth(self) -> None:
        self.model = clone(self._unfitted).fit(self._ds)
        noise = getattr(self.model, "noise_", None)
        if noise is None:
            # nor is there any to look for in a part of the episodes
            self._unfitted.set_params(denoise=None, policy_sees="states")
        else:
            self._smoothed = self.model.smooth(self._ds), noise

    def _on(self, k: int, policies: Mapping[int, Any]) -> _Fit:
        """The fit of fold k; of all episodes at the number of folds."""
        train: Any = slice(None) if k == len(self._folds) else self._folds[k][0]
        if self._smoothed is not None:
            smoothed, noise = self._smoothed
            return lambda model: model._fit_smoothed(smoothed[train], noise)
        if k in policies:
            return _with_policy(self._ds[train], policies[k])
        return lambda model: model.fit(self._ds[train])


def _with_policy(ds: TrajectoryDataset, policy: Any) -> _Fit:
    """Fit that leaves out what it would learn anew: its policy."""

    def fit(model: Any) -> Any:
        model.policy = policy
        model.fit(ds)
        model.policy, model.policy_ = "clone", policy
        return model

    return fit


def _denoises(estimator: Any) -> bool:
    """Whether it smooths the episodes that it is fitted on."""
    return bool(getattr(estimator, "denoise", None) or getattr(estimator, "latent_velocities", 0))


def _fit_all(
    unfitted: Any,
    fits: Sequence[_Fit],
    plain: int,
    verbose: int,
    as_long_as: _Fit | None = None,
) -> list[Any]:
    """A clone fitted in each of several ways; the first `plain` need no separate variance.

    Networks take no fewer steps than that of another fit would.
    """
    learner = _network_of(unfitted)
    if learner is not None:
        return _fit_networks(unfitted, learner, fits, plain, verbose, as_long_as)
    with tqdm(fits, desc="folds", disable=not verbose) as bar:
        return [fit(clone(unfitted)) for fit in bar]


def _network_of(estimator: Any) -> MLPEnsembleRegressor | None:
    """The learner of a dynamics estimator, if it is one that can be trained with others."""
    if not isinstance(estimator, DynamicsEstimator) or not hasattr(estimator, "estimator"):
        return None
    if hasattr(estimator.baseline, "fit"):
        # it would be fitted twice, which may take long
        return None
    learner = estimator.estimator
    if learner is None:
        learner = estimator._defaults()["estimator"]
    return learner if can_join([learner]) else None


def _fit_networks(
    unfitted: Any,
    learner: MLPEnsembleRegressor,
    fits: Sequence[_Fit],
    plain: int,
    verbose: int,
    as_long_as: _Fit | None,
) -> list[Any]:
    """Fit clones, and train their learners together.

    Each is fitted twice: up to where its learner would be trained, and again to the end with the
    trained learner. All else of a fit takes little time, and seeds make it the same both times.
    """
    models = [clone(unfitted) for _ in fits]
    stand_ins = [_asked(model, learner, fit) for model, fit in zip(models, fits)]
    least = 0
    if as_long_as is not None:
        longest = _asked(clone(unfitted), learner, as_long_as)
        least = longest.job(clone(learner).set_params(random_state=0)).n_steps
    learners = [clone(learner).set_params(random_state=s.random_state) for s in stand_ins]
    for one in learners[:plain]:
        if one.probabilistic == "separate":
            one.set_params(probabilistic=False)
    jobs = [stand_in.job for stand_in in stand_ins]
    fit_jointly(learners, jobs, least_steps=least, verbose=verbose)
    for model, stand_in, trained, fit in zip(models, stand_ins, learners, fits):
        stand_in.trained, stand_in.random_state = trained, learner.random_state
        fit(model)
        model.estimator = unfitted.estimator
    return models


def _asked(model: Any, learner: MLPEnsembleRegressor, fit: _Fit) -> "_StandIn":
    """What a model asks of its learner: it is fitted up to there."""
    model.estimator = stand_in = _StandIn(**learner.get_params())
    try:
        with warnings.catch_warnings():
            # they come again
            warnings.simplefilter("ignore")
            fit(model)
    except _Asked:
        pass
    return stand_in


class _Asked(Exception):
    """Training was asked for, and what for is known."""


class _StandIn(MLPEnsembleRegressor):
    """Learner that is not trained when it is fitted: it says on what, or gives a trained one."""

    job: Job
    trained: MLPEnsembleRegressor | None = None

    def __sklearn_clone__(self) -> Self:
        return self

    def fit(self, X: Any, y: Any, *, sample_weight: Any = None, groups: Any = None) -> Any:
        self.job = lambda learner: learner._on_rows(X, y, sample_weight, groups)
        return self._answer()

    def fit_stream(self, draw: Any, *, random_state: Any = None, n_rows: int | None = None) -> Any:
        self.job = lambda learner: learner._on_stream(draw, random_state, n_rows)
        return self._answer()

    def _answer(self) -> MLPEnsembleRegressor:
        if self.trained is None:
            raise _Asked
        return self.trained
