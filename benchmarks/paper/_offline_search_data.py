"""Experiments to choose from, halves of them, and tracking errors predicted from gains alone."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_data import (
    MOTION_UNTIL,
    N_FOLDS,
    Flights,
    Ints,
    flights,
    folds,
    predicted_states,
    starts,
    tracking_errors,
)
from benchmarks.paper._flights_models import follow
from benchmarks.paper._flights_ranking import repeats
from trajlearn import BlockKFold, TrajectoryDataset

Floats = NDArray[np.float64]

RANDOM, LATE, EARLY, FIFTH = "random half", "late half", "early half", "fifth"
#: Splits by what is held out and ranked: half of the experiments of each group at random, the late
#: half (models know the early one: the honest case), the early half, and blocks of a fifth.
SPLITS = (RANDOM, LATE, EARLY, FIFTH)


class Pool(NamedTuple):
    """Flights, and the experiments to choose from.

    Attributes
    ----------
    every : Flights
    errors : ndarray of shape (n_flights,)
        Flown tracking errors [m] over the part of the motion that all flights of a kind log.
    of_flight : ndarray of shape (n_flights,)
        Number of the experiment of each flight.
    table : DataFrame
        A line an experiment, in the order of flying: ``experiment``, ``group``, ``flown`` [m]
        (mean over its flights), ``n_flights`` and ``first``, the number of its first flight.
    """

    every: Flights
    errors: Floats
    of_flight: Ints
    table: pd.DataFrame

    def of_group(self, group: str) -> Ints:
        """Numbers of the experiments of a group."""
        return np.flatnonzero(self.table["group"] == group)

    def flights_of(self, experiments: Ints) -> Ints:
        """Numbers of the flights of some experiments."""
        return np.flatnonzero(np.isin(self.of_flight, experiments))

    def gains(self, experiments: Ints) -> Floats:
        """Gains (n, p) of some experiments."""
        return self.every.ds.params[self.table["first"].to_numpy()[experiments]]

    @property
    def flown(self) -> Floats:
        """Flown tracking error [m] of each experiment."""
        return self.table["flown"].to_numpy()


def pool() -> Pool:
    """All experiments with their flown tracking errors."""
    every = flights()
    assert every.ds.group is not None  # flights have an experiment
    errors = tracking_errors(every.ds.states, every.ds, start_logged=every.start_logged)["common"]
    name, first, of_flight = np.unique(every.ds.group, return_index=True, return_inverse=True)
    count = np.bincount(of_flight)
    flown = np.bincount(of_flight, weights=errors) / count
    columns = {"experiment": name, "group": every.group[first], "flown": flown}
    return Pool(
        every, errors, of_flight, pd.DataFrame(columns | {"n_flights": count, "first": first})
    )


def n_folds(split: str) -> int:
    """How many splits there are of a kind that is not drawn at random."""
    return N_FOLDS if split == FIFTH else 1


def held_out(candidates: Pool, split: str, fold: int) -> tuple[Ints, Ints]:
    """Numbers of the training and of the held-out experiments."""
    if split == RANDOM:
        rng = np.random.default_rng(fold)
        mixed = [rng.permutation(candidates.of_group(g)) for g in np.unique(candidates.every.group)]
        test = np.sort(np.concatenate([some[: len(some) // 2] for some in mixed]))
    else:
        ds = candidates.every.ds
        halves = BlockKFold(2, within=("kind", "motors"))
        found = (
            folds(ds, "block")[fold] if split == FIFTH else list(halves.split(ds))[split == LATE]
        )
        test = np.unique(candidates.of_flight[found[1]])
    return np.setdiff1d(np.arange(len(candidates.table)), test), test


# -- flights that are only planned ---------------------------------------------------------


def planned(candidates: Pool, known: Ints, experiments: Ints) -> TrajectoryDataset:
    """Flights of one group, known before they are flown: gains, set-point and a usual start.

    The set-point and its clock are those of the first flight of that kind with its beginning in
    the log. The start is the median of the known flights of the group at the beginning of the
    motion, without any that of the known flights of the kind, else hovering at the set-point.

    Parameters
    ----------
    candidates : Pool
    known : ndarray
        Numbers of the flights whose first states may be used.
    experiments : ndarray
        To plan; all of one group.
    """
    every, ds = candidates.every, candidates.every.ds
    assert ds.references is not None  # the flights have a set-point
    one = int(candidates.table["first"].iloc[experiments[0]])
    kind = ds.context["kind"]
    alike = np.flatnonzero((kind == kind[one]) & every.start_logged)
    template = ds[[alike[0]]]
    begin = int(starts(template)[0][0])
    phase = template.times - template.time_origin[0]
    # one step beyond the motion, so that its last state is among the predicted ones
    rows = slice(begin, int(np.searchsorted(phase, MOTION_UNTIL[kind[one]])) + 1)
    assert template.references is not None
    references = template.references[rows]
    usual = np.intersect1d(alike, known)
    of_group = usual[every.group[usual] == every.group[one]]
    usual = of_group if len(of_group) else usual
    if len(usual):
        first = [ds.offsets[i] + some[0] for i, some in zip(usual, starts(ds[usual]), strict=True)]
        state = np.median(ds.states[first], axis=0)
    else:
        state = follow(references[:1])[0]
    n = len(experiments)
    return TrajectoryDataset.from_arrays(
        # of what follows the start no model reads a state or an action
        [np.tile(state, (len(references), 1))] * n,
        actions=[np.zeros((len(references) - 1, len(ds.action_names)))] * n,
        params=candidates.gains(experiments),
        references=[references] * n,
        times=[phase[rows] - phase[begin]] * n,
        time_origin=np.full(n, -phase[begin]),
        context={name: [values[one]] * n for name, values in ds.context.items()},
        group=candidates.table["experiment"].to_numpy()[experiments],
        state_names=ds.state_names,
        action_names=ds.action_names,
        param_names=ds.param_names,
        reference_names=ds.reference_names,
    )


def predicted_before(model: Any, candidates: Pool, known: Ints, experiments: Ints) -> Floats:
    """Tracking error [m] that a fitted model predicts of each experiment, from its gains alone.

    Infinite where the forecast diverged.
    """
    result = np.empty(len(experiments))
    group = candidates.table["group"].to_numpy()[experiments]
    for name in np.unique(group):
        mine = group == name
        plan = planned(candidates, known, experiments[mine])
        result[mine] = _errors_of(model, plan, np.ones(len(plan), dtype=bool))
    return result


def predicted_from_own_start(model: Any, candidates: Pool, experiments: Ints) -> Floats:
    """As `predicted_before`, from the first state that each flight really had, where logged.

    Where the beginning is not in the log, that is a state in the middle of the motion, from which
    a model can see how well the flight goes. Mean over the flights of an experiment.
    """
    some = candidates.flights_of(experiments)
    own = _errors_of(model, candidates.every.ds[some], candidates.every.start_logged[some])
    return pd.Series(own).groupby(candidates.of_flight[some]).mean()[experiments].to_numpy()


def _errors_of(model: Any, ds: TrajectoryDataset, start_logged: NDArray[np.bool_]) -> Floats:
    with np.errstate(over="ignore", invalid="ignore"):
        found = tracking_errors(predicted_states(model, ds), ds, start_logged=start_logged)
    return np.where(np.isfinite(found["common"]), found["common"], np.inf)


# -- gains ---------------------------------------------------------------------------------


def distinct_gains(candidates: Pool, group: str) -> dict[str, Floats]:
    """Gains that vary in a group, of each of its experiments; what varies together as one."""
    values = candidates.gains(candidates.of_group(group))
    names: dict[bytes, list[str]] = {}
    columns: dict[bytes, Floats] = {}
    for name, column in zip(candidates.every.ds.param_names, values.T, strict=True):
        order = np.unique(column, return_inverse=True)[1]
        if order.any():
            names.setdefault(order.tobytes(), []).append(name)
            columns.setdefault(order.tobytes(), column)
    return {" = ".join(names[key]): column for key, column in columns.items()}


def noise(candidates: Pool, group: str) -> tuple[float, int, Floats]:
    """Standard deviation of the error between repeats [m], its degrees of freedom, and a guess.

    The guess of each flight of the group is the mean error of its repeats, NaN without any.
    """
    mine = np.flatnonzero(candidates.every.group == group)
    own = candidates.errors[mine] - candidates.flown[candidates.of_flight[mine]]
    free = len(mine) - len(candidates.of_group(group))
    std = float(np.sqrt((own**2).sum() / free)) if free else float("nan")
    return std, free, repeats(candidates.every, candidates.errors)[mine]
