"""Prediction of real Crazyflie flights whose controller gains were tuned by hand.

Flights along a line or a figure of eight, each under gains of its own. Folds never part the
repeats of an experiment, and no test flight is in training: five folds of experiments at random,
and five blocks of the order in which the experiments were flown, which is harder. Forecasts start
at the beginning of the motion and later, and reach 1 to 200 steps (20 ms each). Errors in
physical units, skill against the mean flight, and the rank correlation of predicted and flown
tracking errors. (The paper: its figure of real flights, whose test flights were in training.)
"""

from typing import Any

from benchmarks.paper import _flights_curves as curves
from benchmarks.paper import _flights_models as models
from benchmarks.paper import _flights_ranking as ranking
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._flights_data import FOLDER, HORIZONS, N_FOLDS, SPLITS, STRIDE, flights
from benchmarks.paper._flights_figures import draw
from benchmarks.paper._flights_report import report
from benchmarks.paper._flights_tables import Errors, tables

#: The fold whose flight is drawn.
EXAMPLE = {"split": "block", "fold": 0}


def run(run: Run) -> Tables:
    """Tables of errors, skill and ranking."""
    quick = run.mode == "quick"
    places = [(split, fold) for split in SPLITS for fold in range(N_FOLDS)]
    places = places[:1] if quick else places
    forecasts = [
        {"rows": rows, "split": split, "fold": fold, "mode": run.mode, "seed": seed}
        for split, fold in places
        for rows in models.CELLS
        for seed in seeds_of(rows, split, run.seeds)
    ]
    direct = [{"split": split, "fold": fold, "seed": 0} for split, fold in places]
    errors = Errors(flights())
    for asked, result in zip(forecasts, run.cells(forecasts, models.cell), strict=True):
        kept = {
            row: found
            for row, found in result["rows"].items()
            if row not in models.FIXED or asked["seed"] == run.seeds[0]
        }
        errors.add(asked["split"], asked["fold"], asked["seed"], result | {"rows": kept})
    for asked, result in zip(direct, run.cells(direct, ranking.cell), strict=True):
        errors.add_scores(asked["split"], asked["fold"], 0, result["flights"], result["rows"])
    example = [EXAMPLE | {"mode": run.mode, "seed": run.seeds[0]}]
    (shown,) = run.cells(example, curves.cell)
    return tables(errors) | {"example": curves.example_table(shown)}


def seeds_of(rows: list[str], split: str, seeds: list[int]) -> list[int]:
    """Seeds of a cell: one where nothing is random, and of the other rows on blocks.

    What theta adds to T, and the members of the average, have all seeds on both splits.
    """
    every = rows in (models.AVERAGE, models.NO_GAINS, models.LONG)
    varied = rows != models.CELLS[0] and (every or split == "experiment")
    return seeds if varied else seeds[:1]


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "data": FOLDER,
        "splits": SPLITS if mode == "full" else SPLITS[:1],
        "folds": N_FOLDS if mode == "full" else 1,
        "horizons": HORIZONS,
        "stride": STRIDE,
        "gradient_steps": models.STEPS[mode],
        "rows": [row for rows in models.CELLS for row in rows],
        "average": {"until": models.BLEND[0], "without C from": models.BLEND[1]},
        "estimators": models.described(mode),
    }


BENCHMARK = Benchmark(
    "real-flights", __doc__, run, report, draw, settings, minutes=45, data=(FOLDER,)
)

if __name__ == "__main__":
    BENCHMARK.main()
