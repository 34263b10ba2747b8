"""What each of several forecasters shows on episodes that it was not fitted on."""

import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import NDArray
from sklearn.frozen import FrozenEstimator
from sklearn.model_selection import GroupKFold, check_cv
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from trajlearn.dynamics._joint_folds import fit_folds
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import DivergenceWarning, HorizonWarning
from trajlearn.regressors._threads import threads_for
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["Assessment", "assess_all", "common_states", "held_out_folds", "units_of"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Fold = tuple[Ints, Ints]

# so few episodes (groups) are left out one by one
_FEW = 5


@dataclass(frozen=True, eq=False)
class Assessment:
    """A member, and its forecasts of held-out episodes.

    Attributes
    ----------
    model : estimator
        Fitted on all episodes.
    residuals : ndarray of shape (n, H, k)
        Logged minus forecast states, of the states that are logged; NaN where there is nothing
        to compare, inf from a divergence on.
    elapsed : ndarray of shape (n, H)
        Time from the start to each step; NaN likewise.
    state_names : tuple of str
    state_range : ndarray of shape (2, d_s)
    actions : {"none", "logged", "policy"}
        Where the forecasts took actions from.
    gives_std : bool
        Whether the model gives a standard deviation and samples.
    fit_seconds, predict_seconds : float
        Of all fits, and of forecasting all held-out episodes.
    """

    model: Any
    residuals: Floats
    elapsed: Floats
    state_names: tuple[str, ...]
    state_range: Floats
    actions: str
    gives_std: bool
    fit_seconds: float
    predict_seconds: float


def units_of(ds: TrajectoryDataset) -> Ints:
    """The group of each episode, counted from 0; without groups each is its own."""
    labels = np.arange(len(ds)) if ds.group is None else ds.group
    return np.unique(labels, return_inverse=True)[1].astype(np.intp)


def held_out_folds(ds: TrajectoryDataset, cv: Any, rng: np.random.Generator) -> list[Fold]:
    """Episodes to fit on and episodes to judge by, each at most once.

    Raises
    ------
    ValueError
        If there is one episode (group) only, or one is held out twice.
    """
    units, seed = units_of(ds), int(rng.integers(2**31))
    n_units = int(units.max()) + 1
    if n_units < 2:
        what = "episode" if ds.group is None else "group"
        raise ValueError(
            f"members are judged by {what}s that they were not fitted on, and there is only one "
            f"{what}: give more, or fit the member of your choice by itself."
        )
    splitter = cv
    if isinstance(cv, Integral):
        n_folds = n_units if n_units <= _FEW else min(int(cv), n_units)
        splitter = GroupKFold(n_folds, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # a splitter that has no use for groups was chosen knowingly
        warnings.filterwarnings("ignore", "The groups parameter is ignored", UserWarning)
        folds = list(check_cv(splitter).split(ds, groups=units))
    tested = np.concatenate([test for _, test in folds])
    if len(np.unique(tested)) < len(tested):
        raise ValueError(
            f"cv = {cv!r} holds out an episode twice, but each is to count once: take a splitter "
            "such as KFold or GroupKFold."
        )
    return folds


def assess_all(
    members: list[tuple[str, Any]],
    ds: TrajectoryDataset,
    folds: list[Fold],
    rng: np.random.Generator,
    *,
    n_jobs: int | None,
    verbose: int,
) -> list[Assessment]:
    """Assessment of each member, in their order; each has a stream of random numbers of its own."""
    parallel = effective_n_jobs(n_jobs) > 1
    jobs = [
        delayed(_assess)(name, member, ds, folds, own, parallel, max(verbose - 1, 0))
        for (name, member), own in zip(members, rng.spawn(len(members)))
    ]
    found: Iterator[Assessment] = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
    with tqdm(total=len(members), desc="members", disable=not verbose) as bar:
        assessed = []
        for name, _ in members:
            bar.set_postfix_str(name)
            assessed.append(next(found))
            bar.update()
    # nothing is known of steps that no held-out episode reaches
    known = np.any([~np.isnan(a.residuals).all(axis=(0, 2)) for a in assessed], axis=0)
    n_steps = int(np.flatnonzero(known)[-1]) + 1
    return [
        replace(a, residuals=a.residuals[:, :n_steps], elapsed=a.elapsed[:, :n_steps])
        for a in assessed
    ]


def _assess(
    name: str,
    member: Any,
    ds: TrajectoryDataset,
    folds: list[Fold],
    rng: np.random.Generator,
    parallel: bool,
    verbose: int,
) -> Assessment:
    try:
        if not parallel:
            return _assessed(member, ds, folds, rng, verbose)
        # workers with several threads each would wait for one another
        with threadpool_limits(limits=1), threads_for(0):
            return _assessed(member, ds, folds, rng, verbose)
    except Exception as error:
        error.add_note(f"This happened to the member {name!r} of a HorizonSelector.")
        raise


def _assessed(
    member: Any, ds: TrajectoryDataset, folds: list[Fold], rng: np.random.Generator, verbose: int
) -> Assessment:
    began = time.perf_counter()
    models, model = _fitted(member, ds, folds, rng, verbose)
    fitted = time.perf_counter()
    seed = int(rng.integers(2**31))
    n_steps = int(ds.lengths.max())
    residuals, elapsed = None, np.full((len(ds), n_steps), np.nan)
    for one, (_, test) in zip(models, folds):
        forecast = _forecast(one, ds[test], seed)
        missed = forecast.residuals(ds[test])
        if residuals is None:
            residuals = np.full((len(ds), n_steps, missed.shape[2]), np.nan)
        steps = missed.shape[1]
        residuals[test, :steps] = missed
        elapsed[test, :steps] = forecast.times - forecast.initial_times[:, None]
    assert residuals is not None  # there are folds
    predicted = time.perf_counter()
    return Assessment(
        model,
        residuals,
        elapsed,
        forecast.state_names,
        forecast.state_range,
        forecast.actions,
        _gives_std(model, ds),
        fitted - began,
        predicted - fitted,
    )


def _fitted(
    member: Any, ds: TrajectoryDataset, folds: list[Fold], rng: np.random.Generator, verbose: int
) -> tuple[list[Any], Any]:
    """The models of the folds, and that of all episodes."""
    if isinstance(member, FrozenEstimator):
        return [member] * len(folds), member
    return fit_folds(member, ds, folds, rng=rng, verbose=verbose)


def _forecast(model: Any, ds: TrajectoryDataset, seed: int) -> Forecast:
    with warnings.catch_warnings():
        # who diverges is not chosen, and the report says who did
        for category in (DivergenceWarning, HorizonWarning):
            warnings.simplefilter("ignore", category)
        found = model.predict(ds, random_state=seed)
    if not isinstance(found, Forecast):
        raise TypeError(
            f"{type(model).__name__} predicts {type(found).__name__}, not a Forecast: give "
            "dynamics estimators, or Pipelines that end in one."
        )
    return found


def _gives_std(model: Any, ds: TrajectoryDataset) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = model.predict(ds[:1], return_std=True, horizon=1, n_samples=2, random_state=0)
        except (TypeError, ValueError):
            # those written elsewhere say so in their own ways; whatever else is wrong comes again
            return False
    return found.std is not None and found.samples is not None


def common_states(
    names: Sequence[str], assessed: Sequence[Assessment], ds: TrajectoryDataset
) -> tuple[tuple[str, ...], Floats]:
    """The states that all members forecast, and their range over all episodes.

    Raises
    ------
    ValueError
        If members forecast different ones.
    """
    first = assessed[0]
    for name, other in zip(names, assessed):
        if other.state_names != first.state_names:
            raise ValueError(
                f"members forecast different states: {names[0]!r} {', '.join(first.state_names)}; "
                f"{name!r} {', '.join(other.state_names)}. Let all of them forecast the same ones."
            )
    found = first.state_range.copy()
    columns, _, logged = shared_states(first.state_names, ds)
    found[:, columns] = logged.min(axis=0), logged.max(axis=0)
    return first.state_names, found
