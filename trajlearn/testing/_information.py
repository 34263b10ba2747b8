"""Promises about what a prediction may depend on: its own episode, up to its start."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.testing._case import Case, NotApplicable, require
from trajlearn.testing._system import with_garbage
from trajlearn.trajectories import TrajectoryDataset


def check_an_episode_alone_is_as_in_a_batch(case: Case) -> None:
    """An episode gets the same prediction alone, among others, and in any order."""
    for fitted, ds in case.trained:
        order = np.random.default_rng(0).permutation(len(ds))
        for settings in case.sources:
            batch = np.asarray(fitted.predict(ds, **settings))
            shuffled = np.asarray(fitted.predict(ds[order], **settings))
            case.require_same(shuffled, batch[order], "in another order", exact=False)
            for i, steps in enumerate(ds.lengths):
                alone = np.asarray(fitted.predict(ds[[i]], **settings))[0]
                among = batch[i, :steps] if case.forecasts else batch[i]
                case.require_same(alone, among, f"episode {ds.ids[i]} alone", exact=False)


def check_a_known_std_is_as_in_a_batch(case: Case) -> None:
    """A standard deviation that takes no random numbers is the same alone and in a batch."""
    batch, other = (_std(case, case.test, seed) for seed in (0, 1))
    if not np.array_equal(batch, other, equal_nan=True):
        raise NotApplicable
    for i, steps in enumerate(case.test.lengths):
        alone = _std(case, case.test[[i]], 0)[0]
        among = batch[i, :steps] if case.forecasts else batch[i]
        case.require_same(alone, among, f"std of episode {i} alone", exact=False)


def _std(case: Case, ds: TrajectoryDataset, seed: int) -> NDArray[np.float64]:
    settings = {"random_state": seed} if case.forecasts else {}
    try:
        found: Any = case.fitted.predict(ds, return_std=True, **settings)
    except (TypeError, ValueError) as error:
        raise NotApplicable from error
    return found.std if case.forecasts else found[1]


def check_nothing_after_the_start_is_read(case: Case) -> None:
    """Garbage in all that was measured after the start changes no bit of a prediction."""
    n = len(case.test)
    starts = [np.zeros(n, dtype=np.intp)]
    if case.forecasts:
        starts += [np.full(n, 3), np.arange(n) % 4]
    for fitted, ds in case.trained:
        for start in starts:
            for settings in case.sources:
                settings = {"start": start, **settings} if case.forecasts else {}
                expected = fitted.predict(ds, **settings)
                logged = getattr(expected, "actions", "none") == "logged"
                dirty = with_garbage(ds, start, keep_actions=logged)
                found = fitted.predict(dirty, **settings)
                require(len(found) == n, "another number of predictions.")
                case.require_same(found, expected, f"garbage after start {start.tolist()}")
