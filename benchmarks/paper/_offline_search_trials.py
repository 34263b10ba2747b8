"""Ask and tell over gains that were really flown: how soon does a model find the best ones?"""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_models import build
from benchmarks.paper._offline_search_data import Pool, pool, predicted_before
from benchmarks.paper._offline_search_rows import (
    BEST_GAINS,
    CHANCE,
    FAR,
    GP,
    LCB,
    NO_FORECAST,
    RIDGE,
    T,
    from_gains,
)

Ints = NDArray[np.intp]
Floats = NDArray[np.float64]

#: Rows; those after the models ask for no flown error but the least, or for none.
ROWS = (T, RIDGE, GP, LCB, BEST_GAINS, FAR, CHANCE)
#: The order of the human tuner.
TUNER = "as flown"
N_INITIAL = 5
#: Gradient steps of T, which is fitted again before every trial.
STEPS = {"full": 400, "quick": 100}
#: Orders at random for each set of first trials.
N_CHANCE = 20
#: A trial as good as that has found what there is to find.
WITHIN = 1.05
#: Groups in which a greater share of the experiments is as good as that are no search.
MOST = 0.2
#: Repeats, and how many of them one cell does.
N_REPEATS, BATCH = {"full": 25, "quick": 3}, 5


def cells(candidates: Pool, mode: str) -> list[dict[str, Any]]:
    """What is asked of `cell`."""
    asked = []
    every = list(range(N_REPEATS[mode]))
    for group in searched(candidates):
        for row in ROWS:
            size, n_steps = (1, STEPS[mode]) if row == T else (BATCH, 0)
            asked += [
                {"row": row, "group": group, "repeats": every[i : i + size], "n_steps": n_steps}
                for i in range(0, len(every), size)
            ]
    return asked


def searched(candidates: Pool) -> list[str]:
    """Groups in which the best experiments are few."""
    groups = candidates.table.groupby("group")["flown"]
    share = groups.apply(lambda flown: (flown <= WITHIN * flown.min()).mean())
    return list(share.index[share <= MOST])


def cell(row: str, group: str, repeats: list[int], n_steps: int) -> dict[str, Any]:
    """Experiments of a group in the order in which a row tries them, for each repeat.

    Every repeat begins with experiments at random, the same for all rows, and ends with the best
    of the group: what is tried later changes nothing. ``n_steps``: of T, 0 for the others.
    """
    candidates = pool()
    every = candidates.of_group(group)
    orders = []
    for repeat in repeats:
        mixed = np.random.default_rng(repeat).permutation(every)
        for again in range(N_CHANCE if row == CHANCE else 1):
            rest = np.random.default_rng([repeat, again]).permutation(mixed[N_INITIAL:])
            orders.append(_order(row, candidates, [*mixed[:N_INITIAL]], rest, repeat, n_steps))
    return {"orders": orders}


def _order(
    row: str, candidates: Pool, tried: list[int], rest: Ints, seed: int, n_steps: int
) -> list[int]:
    best = candidates.flown[rest].min()
    while len(rest) and min(candidates.flown[tried]) > best:
        scores = _scores(row, candidates, np.array(tried), rest, seed, n_steps)
        # of equal scores the first in an order at random
        chosen = int(np.argmin(scores))
        tried.append(int(rest[chosen]))
        rest = np.delete(rest, chosen)
    return [int(i) for i in tried]


def _scores(row: str, candidates: Pool, tried: Ints, rest: Ints, seed: int, n_steps: int) -> Floats:
    """What a row, knowing what was tried, expects of the others: less is better."""
    if row in NO_FORECAST:
        return from_gains(row, candidates, tried, rest, seed)
    known = candidates.flights_of(tried)
    model = build(row, "full", seed)
    if row == T:
        model.set_params(estimator__max_steps=n_steps)
    return predicted_before(model.fit(candidates.every.ds[known]), candidates, known, rest)


def tables(
    candidates: Pool, done: list[tuple[dict[str, Any], Any]]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Best flown error so far [mm] by trial, and the trials that a search takes.

    Returns
    -------
    progress : DataFrame
        A line a group, row and trial: ``median``, ``q66`` and ``q95`` over repeats.
    hits : DataFrame
        A line a group, row and repeat: the first trial ``within`` 5 % of the best flown, and that
        of the ``best``.
    """
    runs: dict[tuple[str, str], list[Floats]] = {}
    for asked, result in done:
        key = asked["group"], asked["row"]
        runs.setdefault(key, []).extend(candidates.flown[order] for order in result["orders"])
    for group in dict.fromkeys(group for group, _ in runs):
        runs[group, TUNER] = [candidates.flown[candidates.of_group(group)]]
    progress, hits = [], []
    for (group, row), some in runs.items():
        n = len(candidates.of_group(group))
        so_far = np.full((len(some), n), np.inf)
        for best, flown in zip(so_far, some, strict=True):
            best[: len(flown)] = flown
        so_far = 1e3 * np.minimum.accumulate(so_far, axis=1)
        least = so_far[:, -1:]
        columns = {"trial": np.arange(1, n + 1)}
        columns |= {
            name: np.quantile(so_far, q, axis=0)
            for name, q in (("median", 0.5), ("q66", 0.66), ("q95", 0.95))
        }
        head = {"group": group, "row": row}
        progress.append(pd.DataFrame(head | columns))
        within = (so_far <= WITHIN * least).argmax(axis=1) + 1
        first = (so_far <= least).argmax(axis=1) + 1
        repeat = {"repeat": np.arange(len(some)), "within": within, "best": first}
        hits.append(pd.DataFrame(head | repeat))
    return pd.concat(progress, ignore_index=True), pd.concat(hits, ignore_index=True)
