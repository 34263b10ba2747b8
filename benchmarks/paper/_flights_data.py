"""Real flights for a benchmark: groups, splits, starts, and errors in physical units."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from benchmarks.paper._command import data_folder
from benchmarks.paper._rollouts import expected_warnings
from trajlearn import BlockKFold, TrajectoryDataset, starts_every
from trajlearn.datasets import load_crazyflie_gains

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

FOLDER = "crazyflie_lee_gains"
SPLITS = ("experiment", "block")
N_FOLDS = 5
HORIZONS = (1, 5, 10, 25, 50, 100, 200)
#: Steps from one later start to the next.
STRIDE = 10
#: The axes along which a path leads.
DRIVEN = {"line_y": ("y",), "line_x": ("x",), "figure8": ("x", "y")}
#: From that phase [s] on all flights of a kind are logged, until that phase the set-point moves:
#: the window that ranking compares. What follows is hovering, whose wobble no gain explains.
COMMON_FROM = {"line_y": 1.24, "line_x": 0.24, "figure8": 0.04}
MOTION_UNTIL = {"line_y": 3.54, "line_x": 4.72, "figure8": 7.04}
ATTITUDE = ("roll", "pitch", "yaw")


class Flights(NamedTuple):
    """Flights, and what is known of each."""

    ds: TrajectoryDataset
    group: NDArray[np.str_]
    start_logged: Bools
    violent: Bools


def load() -> tuple[TrajectoryDataset, Any]:
    """The clean flights along a path, and the table of their facts."""
    return load_crazyflie_gains(data_folder(FOLDER), kinds=tuple(DRIVEN), return_info=True)


def flights() -> Flights:
    """The flights whose place in the motion is known."""
    ds, info = load()
    known = np.isfinite(ds.time_origin)
    ds, info = ds[known], info[known]
    kind, motors = ds.context["kind"].tolist(), ds.context["motors"].tolist()
    return Flights(
        ds,
        np.array([f"{k}, {m} motors" for k, m in zip(kind, motors, strict=True)]),
        info["start_logged"].to_numpy(dtype=bool),
        info["violent"].to_numpy(dtype=bool),
    )


def folds(ds: TrajectoryDataset, split: str) -> list[tuple[Ints, Ints]]:
    """Training and test flights of each fold; repeats of an experiment are never parted."""
    if split == "block":
        return list(BlockKFold(N_FOLDS, within=("kind", "motors")).split(ds))
    shuffled = GroupKFold(N_FOLDS, shuffle=True, random_state=0)
    return list(shuffled.split(ds.lengths, groups=ds.group))


def starts(ds: TrajectoryDataset) -> list[Ints]:
    """The beginning of the motion (or of the log, if later), and every tenth state after it."""
    return starts_every(ds, STRIDE, first="motion")


# -- errors by horizon --------------------------------------------------------------------


class Starts(NamedTuple):
    """Starts of forecasts, and the states some horizons later (n, n_horizons, d_s)."""

    episode: Ints
    first: Bools
    truth: Floats


def truth_at(ds: TrajectoryDataset) -> Starts:
    """What a forecast from each start has to meet; NaN beyond the log."""
    by_flight = starts(ds)
    episode = np.repeat(np.arange(len(ds)), [len(some) for some in by_flight])
    start = np.concatenate(by_flight)
    end = start[:, None] + np.array(HORIZONS)
    row = ds.offsets[:-1][episode, None] + np.minimum(end, ds.lengths[episode, None])
    within = end <= ds.lengths[episode, None]
    first = np.r_[True, episode[1:] != episode[:-1]]
    return Starts(episode, first, np.where(within[..., None], ds.states[row], np.nan))


def squared_errors(
    forecast: Floats, at: Starts, n_flights: int, *, motion: Bools
) -> dict[str, Floats]:
    """Mean over the starts of each flight of the squared error (n_flights, n_horizons, d_s).

    Parameters
    ----------
    forecast : ndarray of shape (n, n_horizons, d_s)
        Infinite after a divergence.
    at : Starts
    n_flights : int
    motion : ndarray of shape (n_flights,)
        Whether the log shows the beginning of the motion.

    Returns
    -------
    dict of ndarray
        ``motion``: from there, of these flights; ``later``: from later in the log. NaN without.
    """
    squared = (forecast - at.truth) ** 2
    begins = at.first & motion[at.episode]
    return {
        kind: _mean_by(squared[chosen], at.episode[chosen], n_flights)
        for kind, chosen in {"motion": begins, "later": ~begins}.items()
    }


def _mean_by(values: Floats, episode: Ints, n: int) -> Floats:
    """Mean of the rows of each episode, NaN left out; NaN without any."""
    there = ~np.isnan(values)
    total, count = (np.zeros((n, *values.shape[1:])) for _ in range(2))
    np.add.at(total, episode, np.where(there, values, 0.0))
    np.add.at(count, episode, there)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


# -- tracking error of a flight -----------------------------------------------------------


def tracking_errors(
    states: Floats, ds: TrajectoryDataset, *, start_logged: Bools
) -> dict[str, Floats]:
    """Root mean square tracking error [m] along the driven axes of each flight.

    Parameters
    ----------
    states : ndarray of shape (rows, d_s)
        Flown, or predicted from the first start on; as the rows of ``ds.states``.
    ds : TrajectoryDataset
    start_logged : ndarray of shape (n,)

    Returns
    -------
    dict of ndarray of shape (n,)
        ``common``: over the part of the motion that all flights of the kind have; ``full``: over
        all of it, NaN where its beginning is not logged.
    """
    assert ds.references is not None  # the flights have a set-point
    result = {name: np.full(len(ds), np.nan) for name in ("common", "full")}
    for i, first in enumerate(starts(ds)):
        kind = ds.context["kind"][i]
        rows = np.arange(ds.offsets[i] + first[0] + 1, ds.offsets[i + 1])
        axes = [ds.state_names.index(name) for name in DRIVEN[kind]]
        off = states[np.ix_(rows, axes)] - ds.references[np.ix_(rows, axes)]
        squared = (off**2).sum(axis=1)
        phase = ds.times[rows] - ds.time_origin[i]
        moving = phase <= MOTION_UNTIL[kind]
        common = moving & (phase >= COMMON_FROM[kind])
        result["common"][i] = np.sqrt(squared[common].mean())
        if start_logged[i]:
            result["full"][i] = np.sqrt(squared[moving].mean())
    return result


def predicted_states(model: Any, ds: TrajectoryDataset) -> Floats:
    """States (rows, d_s) predicted from the first start on, to the end of each flight."""
    first = np.array([some[0] for some in starts(ds)])
    with expected_warnings():
        forecast = model.predict(ds, start=first)
    states = ds.states.copy()
    for i, (begin, n) in enumerate(zip(first, forecast.lengths, strict=True)):
        row = ds.offsets[i] + begin + 1
        states[row : row + n] = forecast.mean[i, :n]
    return states
