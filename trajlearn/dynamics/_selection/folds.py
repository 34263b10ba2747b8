"""Which episodes are held out together, and what is independent of one another."""

import warnings
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold, check_cv

from trajlearn.trajectories import TrajectoryDataset

__all__ = ["FEW", "Fold", "held_out_folds", "units_of"]

Ints = NDArray[np.intp]
Fold = tuple[Ints, Ints]
#: So few episodes (groups) are left out one by one.
FEW = 5


def units_of(ds: TrajectoryDataset) -> Ints:
    """The group of each episode, counted from 0; without groups each is its own."""
    labels = np.arange(len(ds)) if ds.group is None else ds.group
    return np.unique(labels, return_inverse=True)[1].astype(np.intp)


def held_out_folds(ds: TrajectoryDataset, cv: Any, rng: np.random.Generator) -> list[Fold]:
    """Episodes to fit on and episodes to judge by, each at most once.

    Raises
    ------
    ValueError
        If there is one episode (group) only; if one is held out twice, or by a fold that trains
        on it; if a fold, or all of them, are empty.
    """
    units, seed = units_of(ds), int(rng.integers(2**31))
    n_units = int(units.max()) + 1
    if n_units < 2:
        what = "episode" if ds.group is None else "group"
        raise ValueError(
            f"members are judged by {what}s that they were not fitted on, and there is only one "
            f"{what}: give more, or fit the member of your choice by itself. A "
            f"CalibratedForecaster around a selector holds out {what}s of its own first: give it "
            "three or more, or calibrate a fitted selector, "
            "CalibratedForecaster(FrozenEstimator(selector)), on others."
        )
    splitter = cv
    if isinstance(cv, Integral):
        n_folds = n_units if n_units <= FEW else min(int(cv), n_units)
        splitter = GroupKFold(n_folds, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # a splitter that has no use for groups was chosen knowingly
        warnings.filterwarnings("ignore", "The groups parameter is ignored", UserWarning)
        folds = list(check_cv(splitter).split(ds, groups=units))
    folds = [(_indices(train, len(ds)), _indices(test, len(ds))) for train, test in folds]
    _check(folds)
    return folds


def _indices(episodes: Any, n: int) -> Ints:
    """Episodes that were given as indices, perhaps none, or as a mask."""
    given = np.asarray(episodes)
    return np.arange(n)[given] if given.size else np.arange(0)


def _check(folds: list[Fold]) -> None:
    if not folds or not all(len(train) and len(test) for train, test in folds):
        raise ValueError(
            "cv gives no fold, or an empty one: each needs episodes to train on and others to "
            "hold out."
        )
    for k, (train, test) in enumerate(folds):
        if len(both := np.intersect1d(train, test)):
            raise ValueError(
                f"fold {k} of cv trains on episodes that it holds out, such as number {both[0]}: "
                "a member would be judged by what it has seen. Leave them out of one side."
            )
    tested = np.concatenate([test for _, test in folds])
    if len(np.unique(tested)) < len(tested):
        raise ValueError(
            "cv holds out an episode twice, but each is to count once: take a splitter such as "
            "KFold or GroupKFold."
        )
