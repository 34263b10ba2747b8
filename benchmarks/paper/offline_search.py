"""Choose among gains of real flights that a model has not seen: ranks, regret, and trials saved.

A policy search without a simulator. Models know half of the experiments in which the gains of a
Crazyflie were tuned, and rank those of the other half by the tracking error that they predict
before the flight: from the gains, the set-point and a usual start. Regret: the flown error of the
choice minus that of the best flown. Halves at random and in time (a model of the early tuning
stages ranks the late ones). And ask and tell over what was flown: how many experiments until the
best is found?
"""

from typing import Any

from benchmarks.paper import _offline_search_ranking as ranking
from benchmarks.paper import _offline_search_rows as rows
from benchmarks.paper import _offline_search_trials as trials
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._flights_data import COMMON_FROM, FOLDER, MOTION_UNTIL
from benchmarks.paper._flights_models import STEPS, build
from benchmarks.paper._offline_search_data import SPLITS, pool
from benchmarks.paper._offline_search_figures import draw
from benchmarks.paper._offline_search_page import report


def run(run: Run) -> Tables:
    """Tables of choices, taste in gains, and trials."""
    candidates = pool()
    ranked = ranking.cells(run.mode, run.seeds)
    done = list(zip(ranked, run.cells(ranked, ranking.cell), strict=True))
    asked = trials.cells(candidates, run.mode)
    tried = list(zip(asked, run.cells(asked, trials.cell), strict=True))
    progress, hits = trials.tables(candidates, tried)
    return {
        "pool": ranking.pool_table(candidates),
        "choices": ranking.choice_table(candidates, done),
        "scores": ranking.score_table(candidates, done),
        "gains": ranking.gain_table(candidates, done),
        "progress": progress,
        "hits": hits,
    }


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "data": FOLDER,
        "window": {"from": COMMON_FROM, "until": MOTION_UNTIL, "unit": "s"},
        "splits": SPLITS if mode == "full" else SPLITS[:2],
        "gradient_steps": {"ranking": STEPS[mode], "search": trials.STEPS[mode]},
        "search": {
            "rows": trials.ROWS,
            "repeats": trials.N_REPEATS[mode],
            "initial": trials.N_INITIAL,
            "kappa": rows.KAPPA,
        },
        "estimators": {
            row: " ".join(str(build(row, mode, 0)).split())
            for row in (rows.T, rows.NO_GAINS, rows.C, rows.RIDGE)
        },
    }


BENCHMARK = Benchmark(
    "offline-search", __doc__, run, report, draw, settings, minutes=12, seeds=10, data=(FOLDER,)
)

if __name__ == "__main__":
    BENCHMARK.main()
