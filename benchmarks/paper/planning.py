"""Planning on the cartpole: what a decision is worth, how long it takes, and what is held.

Random shooting with 1,000 candidates, by T over policies and by a one-step model (D, with the
policy) over policies and over actions; decided once, or again after 25, 5 or 1 steps. Models see
the paper's log, in which episodes that fell are drawn again. Trials begin within 0.25 of upright,
and the reward is exp(-(x^2 + theta^2)) a step, nothing after a fall. Then what trials are worth
as data when theta changes in them. (The paper: its figure on planning.)
"""

from typing import Any

import pandas as pd

from benchmarks._sweep import Cell
from benchmarks.paper import _planning_refit as refits
from benchmarks.paper import _planning_trials as trials
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._planning_figures import draw
from benchmarks.paper._planning_page import report


def run(run: Run) -> Tables:
    """Trials of all planners, the choices that they face, and models that are fitted anew."""
    flown = [
        {"planner": name, "trials": share, "mode": run.mode, "seed": seed}
        for seed in run.seeds
        for name, how in trials.PLANNERS.items()
        for share in _shares(how.costly, run, seed)
    ]
    faced = [
        {"planner": name, "model": model, "mode": run.mode, "seed": seed}
        for seed in run.seeds
        for name in trials.LOOKED_AT
        for model in ("T", "D")
    ]
    return {
        "trials": _lines(flown, run.cells(flown, trials.cell), ["planner", "seed"]),
        "choices": _lines(faced, run.cells(faced, trials.choices), ["planner", "model", "seed"]),
        **_refitted(run),
    }


def _shares(costly: bool, run: Run, seed: int) -> list[list[int]]:
    """Trials of each cell of a planner: all, or those of a costly one that fall to a seed."""
    if not costly:
        return [list(range(trials.N_TRIALS[run.mode]))]
    own = list(range(trials.N_COSTLY[run.mode]))[run.seeds.index(seed) :: len(run.seeds)]
    return [own[i : i + trials.CHUNK] for i in range(0, len(own), trials.CHUNK)]


def _refitted(run: Run) -> Tables:
    """Rows and errors by horizon, and trials, for every way to gather more data."""
    cells = [
        {"hold": hold, "mode": run.mode, "seed": seed}
        for seed in run.seeds
        for hold in refits.HOLDS
    ]
    key = ["hold", "seed"]
    results = run.cells(cells, refits.cell)
    named = [cell | {"hold": refits.label(cell["hold"])} for cell in cells]
    return {
        "rows": _lines(named, [r["rows"] for r in results], key),
        "errors": _lines(named, [r["errors"] for r in results], key),
        "refits": pd.concat(
            [
                _lines(named, [r[when] for r in results], key).assign(when=when)
                for when in ("added", "next")
            ],
            ignore_index=True,
        ),
    }


def _lines(cells: list[Cell], results: list[Any], key: list[str]) -> pd.DataFrame:
    """Records (or columns) of all cells as one table, each with the key of its cell first."""
    tables = [
        pd.DataFrame(result).assign(**{name: cell[name] for name in key})
        for cell, result in zip(cells, results, strict=True)
        if result
    ]
    table = pd.concat(tables, ignore_index=True)
    return table[[*key, *table.columns.difference(key, sort=False)]]


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "planners": {name: how._asdict() for name, how in trials.PLANNERS.items()},
        "n_train": trials.N_TRAIN,
        "length": trials.LENGTH,
        "n_trials": trials.N_TRIALS[mode],
        "n_trials_of_costly_planners_over_all_seeds": trials.N_COSTLY[mode],
        "n_candidates": trials.N_CANDIDATES[mode],
        "refitting": {
            "n_first": refits.N_FIRST,
            "n_more": refits.N_MORE[mode],
            "n_test": refits.N_TEST[mode],
            "n_candidates": refits.N_CANDIDATES[mode],
        },
    }


BENCHMARK = Benchmark("planning", __doc__, run, report, draw, settings, minutes=15)

if __name__ == "__main__":
    BENCHMARK.main()
