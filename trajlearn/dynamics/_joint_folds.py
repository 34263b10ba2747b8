"""The models of all folds and that of all episodes, trained together where the learner allows."""

import warnings
from collections.abc import Callable, Sequence
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

__all__ = ["fit_folds"]

Ints = NDArray[np.intp]
# fits an unfitted model
_Fit = Callable[[Any], Any]


def fit_folds(
    estimator: Any,
    ds: TrajectoryDataset,
    folds: Sequence[tuple[Ints, Ints]],
    *,
    rng: np.random.Generator,
    std: bool = True,
    verbose: int = 0,
) -> tuple[list[Any], Any]:
    """Fit an estimator on the training episodes of each fold, and on all episodes.

    A dynamics estimator over an `MLPEnsembleRegressor` trains the networks of all of them as one,
    see `trajlearn.regressors._joint`: those of the folds take as many steps as that of all
    episodes. Anything else is fitted one by one.

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
    verbose : int, default=0
        1 shows a progress bar.

    Returns
    -------
    models : list of estimator
        One a fold.
    model : estimator
        Of all episodes.
    """
    unfitted = seeded(estimator, rng)
    parts = [ds[train] for train, _ in folds]
    plain = 0 if std else len(parts)
    if not _denoises(unfitted):
        fits = [_on(part) for part in [*parts, ds]]
        *models, model = _fit_all(unfitted, fits, plain, verbose)
        return models, model
    model = clone(unfitted).fit(ds)
    noise = getattr(model, "noise_", None)
    if noise is None:
        # nor is there any to look for in a part of the episodes
        unfitted.set_params(denoise=None, policy_sees="states")
        return _fit_all(unfitted, [_on(part) for part in parts], plain, verbose), model
    smoothed = model.smooth(ds)
    fits = [_on_smoothed(smoothed[train], noise) for train, _ in folds]
    return _fit_all(unfitted, fits, plain, verbose), model


def _denoises(estimator: Any) -> bool:
    """Whether it smooths the episodes that it is fitted on."""
    return bool(getattr(estimator, "denoise", None) or getattr(estimator, "latent_velocities", 0))


def _on(ds: TrajectoryDataset) -> _Fit:
    return lambda model: model.fit(ds)


def _on_smoothed(ds: TrajectoryDataset, noise: Any) -> _Fit:
    return lambda model: model._fit_smoothed(ds, noise)


def _fit_all(unfitted: Any, fits: Sequence[_Fit], plain: int, verbose: int) -> list[Any]:
    """A clone fitted in each of several ways; the first `plain` need no separate variance."""
    learner = _network_of(unfitted)
    if learner is not None:
        return _fit_networks(unfitted, learner, fits, plain, verbose)
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
) -> list[Any]:
    """Fit clones, and train their learners together.

    Each is fitted twice: up to where its learner would be trained, and again to the end with the
    trained learner. All else of a fit takes little time, and seeds make it the same both times.
    """
    models, stand_ins = [], []
    for fit in fits:
        model, stand_in = clone(unfitted), _StandIn(**learner.get_params())
        model.estimator = stand_in
        try:
            with warnings.catch_warnings():
                # they come again
                warnings.simplefilter("ignore")
                fit(model)
        except _Asked:
            pass
        models.append(model)
        stand_ins.append(stand_in)
    learners = [clone(learner).set_params(random_state=s.random_state) for s in stand_ins]
    for one in learners[:plain]:
        if one.probabilistic == "separate":
            one.set_params(probabilistic=False)
    fit_jointly(learners, [stand_in.job for stand_in in stand_ins], verbose=verbose)
    for model, stand_in, trained, fit in zip(models, stand_ins, learners, fits):
        stand_in.trained, stand_in.random_state = trained, learner.random_state
        fit(model)
        model.estimator = unfitted.estimator
    return models


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
