"""What each of several forecasters shows on episodes that it was not fitted on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from trajlearn.dynamics._selection.entrant import Assessment, Entrant, judged
from trajlearn.dynamics._selection.folds import FEW, Fold, units_of
from trajlearn.dynamics._selection.losses import horizon_losses
from trajlearn.dynamics._selection.race import enough_to_race, in_the_race
from trajlearn.dynamics._selection.shared_policies import SharedPolicies
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.regressors._threads import by_workers
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["assess_all", "errors_in_ranges", "states_of"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def assess_all(
    members: list[tuple[str, Any]],
    ds: TrajectoryDataset,
    folds: list[Fold],
    rng: np.random.Generator,
    *,
    bandwidth: float,
    n_kept: int | None,
    n_jobs: int | None,
    verbose: int,
) -> list[Assessment]:
    """Assessment of each member, in their order; each has a stream of random numbers of its own.

    Parameters
    ----------
    members : list of (str, estimator)
    ds : TrajectoryDataset
    folds : list of (train, test)
    rng : Generator
    bandwidth : float
        Of the losses.
    n_kept : int or None
        None: all are judged by all folds. Otherwise they race: after the first and the second
        fold those leave that are surely behind, but for the best `n_kept`, and for the frozen
        ones, which cost little.
    n_jobs : int or None
    verbose : int
    """
    *own, of_policies = rng.spawn(len(members) + 1)
    entrants = [Entrant(name, m, ds, folds, r) for (name, m), r in zip(members, own)]
    shared = SharedPolicies(members, ds, folds, of_policies, n_jobs)
    units, n_folds = units_of(ds), len(folds)
    # what the first and the second fold say decides who goes on; the rest is trained together
    alone = 0 if n_kept is None or len(ds) <= FEW else min(n_folds - 1, 2)
    heats = [*(range(k, k + 1) for k in range(alone)), range(alone, n_folds)]
    racing = list(range(len(members)))
    with tqdm(total=len(members) * (n_folds + 1), disable=not verbose, unit="fit") as bar:
        for which in heats:
            last = which[-1] == n_folds - 1
            fits = [*which, n_folds] if last else which
            bar.set_description(_told(len(racing), len(members), which, last))
            shared.learn([members[i][0] for i in racing], fits)
            jobs = [
                (entrants[i], which, last, shared.of(members[i][0]), max(verbose - 1, 0))
                for i in racing
            ]
            for i, entrant in zip(racing, by_workers(judged, jobs, n_jobs)):
                entrants[i] = entrant
                bar.set_postfix_str(f"{entrant.name} done")
                bar.update(len(fits))
            seen = np.concatenate([folds[k][1] for k in range(which[-1] + 1)])
            if n_kept is None or last or not enough_to_race(units[seen]):
                continue
            some = [entrants[i] for i in racing]
            errors = errors_in_ranges([entrant.assessment() for entrant in some], ds)[1]
            stays = in_the_race(horizon_losses(errors, units, bandwidth), n_kept)
            stays |= [entrant.frozen for entrant in some]
            racing = [i for i, stay in zip(racing, stays) if stay]
            bar.total -= int((~stays).sum()) * (n_folds - which[-1])
    assessed = [entrant.assessment(shared.seconds(entrant.name)) for entrant in entrants]
    # nothing is known of steps that no held-out episode reaches
    known = np.any([~np.isnan(a.residuals).all(axis=(0, 2)) for a in assessed], axis=0)
    n_steps = int(np.flatnonzero(known)[-1]) + 1
    return [
        replace(a, residuals=a.residuals[:, :n_steps], elapsed=a.elapsed[:, :n_steps])
        for a in assessed
    ]


def _told(n_racing: int, n_members: int, which: Sequence[int], last: bool) -> str:
    """What a progress bar says."""
    folds = f"folds {which[0] + 1}-{which[-1] + 1}" if len(which) > 1 else f"fold {which[0] + 1}"
    return f"{n_racing} of {n_members} members, {folds}{' and all episodes' if last else ''}"


def states_of(
    assessed: Sequence[Assessment], ds: TrajectoryDataset
) -> tuple[tuple[str, ...], Floats, Ints]:
    """The states that all members forecast, their range over all episodes, and those logged.

    Raises
    ------
    ValueError
        If members forecast different ones.
    """
    first = assessed[0]
    for other in assessed:
        if other.state_names != first.state_names:
            raise ValueError(
                f"members forecast different states: {first.name!r} "
                f"{', '.join(first.state_names)}; {other.name!r} {', '.join(other.state_names)}. "
                "Let all of them forecast the same ones."
            )
    found = first.state_range.copy()
    columns, _, logged = shared_states(first.state_names, ds)
    found[:, columns] = logged.min(axis=0), logged.max(axis=0)
    return first.state_names, found, columns


def errors_in_ranges(
    assessed: Sequence[Assessment], ds: TrajectoryDataset
) -> tuple[Floats, Floats]:
    """Residuals (M, n, H, k) in training ranges, and their mean squares over states (M, n, H)."""
    _, state_range, columns = states_of(assessed, ds)
    low, high = state_range[:, columns]
    scaled = np.stack([a.residuals for a in assessed]) / np.where(high > low, high - low, 1.0)
    with np.errstate(over="ignore"):
        return scaled, (scaled**2).mean(axis=3)
