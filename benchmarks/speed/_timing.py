"""Timing several cases side by side: interleaved rounds, medians, ratios to the first case."""

import gc
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Case:
    """One thing to time; `units` is what a call's time is divided by, such as steps taken."""

    name: str
    run: Callable[[], object]
    units: float = 1.0
    goal: str = ""


def measure(
    cases: Sequence[Case],
    *,
    rounds: int,
    min_seconds: float = 0.0,
    warm: bool = True,
    **labels: Any,
) -> list[dict[str, Any]]:
    """Time the cases; the first is what the others are compared with.

    Every round runs every case, each round beginning with another one, so that a slow spell of the
    machine meets all of them; a ratio is taken within a round. The clock is the CPU time of the
    process: with one thread it is what a free core would take.

    Parameters
    ----------
    cases : sequence of Case
    rounds : int
    min_seconds : float
        Repeat a call within a round until it takes about this long.
    warm : bool
        Whether calls that are not timed go ahead; without, each is made once a round.
    **labels
        Copied into every row.

    Returns
    -------
    list of dict
        A row for each case: median and quartiles of seconds a unit and of the ratio.
    """
    repeats = [_repeats(case.run, min_seconds) if warm else 1 for case in cases]
    seconds = np.empty((rounds, len(cases)))
    with _without_garbage_collection():
        for k in range(rounds):
            for j in np.roll(np.arange(len(cases)), -k).tolist():
                seconds[k, j] = _time(cases[j].run, repeats[j]) / cases[j].units
    ratios = seconds / seconds[:, :1]
    return [
        {
            **labels,
            "case": case.name,
            "base": case is cases[0],
            "goal": case.goal,
            "rounds": rounds,
            "calls_a_round": repeat,
            "seconds": float(np.median(own)),
            "seconds_quartiles": np.quantile(own, [0.25, 0.75]).tolist(),
            "ratio": float(np.median(ratio)),
            "ratio_quartiles": np.quantile(ratio, [0.25, 0.75]).tolist(),
        }
        for case, repeat, own, ratio in zip(cases, repeats, seconds.T, ratios.T, strict=True)
    ]


def spread(rows: Sequence[dict[str, Any]]) -> float:
    """Median over the compared cases of the interquartile range of the ratio, as a share of it."""
    shares = [np.ptp(row["ratio_quartiles"]) / row["ratio"] for row in rows if not row["base"]]
    return float(np.median(shares))


def _time(run: Callable[[], object], repeats: int) -> float:
    begin = time.process_time()
    for _ in range(repeats):
        run()
    return (time.process_time() - begin) / repeats


def _repeats(run: Callable[[], object], min_seconds: float) -> int:
    """Warm up, and see how many calls fill the time."""
    run()
    return max(1, math.ceil(min_seconds / max(_time(run, 1), 1e-6)))


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
