"""1e5 rows of cartpole's sizes from 100 episodes: our relabelers, all pairs listed, a plain loop.

What takes too long, or does not fit into memory, runs on a part of the pairs; its time and memory
are extrapolated in proportion, and the table says so. Ratios are to drawing two row numbers and
copying the columns of as many rows: the least that any sampling can do. 100 episodes of 200 steps
have 20,000 transitions in all.
"""

import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed._command import (
    Columns,
    Row,
    command_line,
    duration,
    one_thread,
    quartiles,
    result,
    times,
)
from benchmarks.speed._timing import Case, measure
from trajlearn import SubtrajectoryRelabeler, TrajectoryDataset, TransitionRelabeler

NAME = "relabel"
N_STATES, N_ACTIONS, N_PARAMS = 4, 1, 4
# steps of the one episode that the plain loop is timed on; its cost a pair is constant
LOOP_STEPS = 150
# pairs that listing runs on at most: 160 MB of row numbers
LISTED_PAIRS = 10_000_000

COLUMNS: Columns = {
    "episodes": lambda row: f"{row['episodes']} x {row['steps']:,}",
    "what": lambda row: row["case"],
    "time": lambda row: duration(row["seconds"]),
    "bare copy": lambda row: times(row["ratio"]),
    "quartiles": quartiles,
    "peak memory": lambda row: f"{row['peak_megabytes']:,.0f} MB",
    "part run": lambda row: "all" if row["part"] == 1 else f"{100 * row['part']:.2g} %",
    "goal": lambda row: row["goal"],
}

Floats = NDArray[np.float64]
Rows = tuple[Floats, Floats]


@dataclass(frozen=True)
class Effort:
    """How much to run."""

    rounds: int
    n_rows: int = 100_000
    episodes: int = 100
    steps: Sequence[int] = (200, 2000)


EFFORT = {"quick": Effort(rounds=5), "full": Effort(rounds=41)}


def run(mode: str, effort: Effort) -> dict[str, Any]:
    """Time every case for every length of the episodes, then measure its peak memory."""
    rows: list[Row] = []
    with one_thread():
        for steps in effort.steps:
            parts = _cases(effort.episodes, steps, effort.n_rows)
            measured = measure(
                [case for case, _ in parts],
                rounds=effort.rounds,
                episodes=effort.episodes,
                steps=steps,
            )
            for row, (case, part) in zip(measured, parts, strict=True):
                rows.append({**row, "part": part, "peak_megabytes": _peak(case.run) / part})
    return result(NAME, mode, rows, asdict(effort))


def _cases(n_episodes: int, steps: int, n_rows: int) -> list[tuple[Case, float]]:
    """Cases, and the part of the pairs that each runs on."""
    ds = _episodes(n_episodes, steps)
    pairs = steps * (steps + 1) // 2
    listed = max(1, min(n_episodes, LISTED_PAIRS // pairs))
    loop = _episodes(1, min(steps, LOOP_STEPS))
    share = SubtrajectoryRelabeler().n_pairs(loop) / (n_episodes * pairs)
    rng = np.random.default_rng(0)
    uniform = SubtrajectoryRelabeler(max_rows=n_rows, random_state=rng)
    early = SubtrajectoryRelabeler(
        max_rows=n_rows, starts="early", horizons="mixture", random_state=rng
    )
    transitions = TransitionRelabeler(max_rows=n_rows, random_state=rng)
    name, goal = SubtrajectoryRelabeler.__name__, "15 ms"

    def part_of(what: str, call: Callable[[], object], part: float) -> tuple[Case, float]:
        return Case(what, call, part), part

    return [
        (Case("bare copy", lambda: _bare_copy(ds, n_rows, rng)), 1.0),
        (Case(name, lambda: uniform.fit_resample(ds), goal=goal), 1.0),
        (
            Case(
                f"{name}, early starts, mixed horizons", lambda: early.fit_resample(ds), goal=goal
            ),
            1.0,
        ),
        (Case("TransitionRelabeler", lambda: transitions.fit_resample(ds)), 1.0),
        part_of(
            "numpy, all pairs listed",
            lambda: _listing(ds[:listed], n_rows, rng),
            listed / n_episodes,
        ),
        part_of("Python loop over pairs", lambda: _loop(loop), share),
    ]


def _episodes(n_episodes: int, steps: int) -> TrajectoryDataset:
    rng = np.random.default_rng(0)
    return TrajectoryDataset.from_arrays(
        rng.normal(size=(n_episodes, steps + 1, N_STATES)),
        actions=rng.normal(size=(n_episodes, steps, N_ACTIONS)),
        params=rng.normal(size=(n_episodes, N_PARAMS)),
        dt=0.02,
    )


def _peak(call: Callable[[], object]) -> float:
    """Most memory in use during a call, in MB."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def _params(ds: TrajectoryDataset) -> Floats:
    if ds.params is None:
        raise ValueError("the episodes need params.")
    return ds.params


def _gather(
    ds: TrajectoryDataset,
    episode: NDArray[np.intp],
    begin: NDArray[np.intp],
    end: NDArray[np.intp],
) -> Rows:
    rows = np.empty((len(begin), N_STATES + 1 + N_PARAMS))
    rows[:, :N_STATES] = ds.states.take(begin, axis=0)
    rows[:, N_STATES] = ds.times[end] - ds.times[begin]
    rows[:, N_STATES + 1 :] = _params(ds).take(episode, axis=0)
    return rows, ds.states.take(end, axis=0)


def _bare_copy(ds: TrajectoryDataset, n_rows: int, rng: np.random.Generator) -> Rows:
    """Rows of any two states: what is left if nothing has to be right."""
    begin, end = rng.integers(len(ds.states), size=(2, n_rows))
    return _gather(ds, begin // ds.offsets[1], begin, end)


def _listing(ds: TrajectoryDataset, n_rows: int, rng: np.random.Generator) -> Rows:
    """List the pairs of every episode, then draw."""
    pairs = [np.triu_indices(length + 1, k=1) for length in ds.lengths]
    begin = np.concatenate([i + first for (i, _), first in zip(pairs, ds.offsets)])
    end = np.concatenate([j + first for (_, j), first in zip(pairs, ds.offsets)])
    episode = np.repeat(np.arange(len(ds)), [len(i) for i, _ in pairs])
    drawn = rng.choice(len(begin), size=min(n_rows, len(begin)), replace=False, shuffle=False)
    return _gather(ds, episode[drawn], begin[drawn], end[drawn])


def _loop(ds: TrajectoryDataset) -> tuple[list[Floats], list[Floats]]:
    """Every pair of every episode, one after the other."""
    rows, targets = [], []
    for episode, theta in zip(ds, _params(ds), strict=True):
        states, times = episode.states, episode.times
        for i in range(len(states)):
            for j in range(i + 1, len(states)):
                rows.append(np.concatenate([states[i], [times[j] - times[i]], theta]))
                targets.append(states[j])
    return rows, targets


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    command_line(NAME, __doc__ or "", run, EFFORT, COLUMNS, argv)


if __name__ == "__main__":
    main()
