"""Does the uncertainty of one-step models explode, and does any model know how wrong it is?

Forecasts with standard deviations, raw and calibrated on episodes of their own. On cartpole and
reacher, without and with measurement noise of 3 % of the standard deviation of each state: P, PE
(with each propagation), Gaussian processes of one step, an LSTM, TP, TPE, and T with a variance
network. P, PE, TPE and T also on the simulated quadrotor, whose process noise is its own, and on
real flights. All with our settings; one-step models recompute actions by the policy, and where
tables say so replay the logged ones, as the paper's do. Every model is fitted on 100 episodes of
200 steps, calibrated on up to 200 others, and tested on up to 1,000 others again; the truth is
what was measured. Real flights are parted by experiments.

Other measurement noise and other process noise take as long again: --more runs them, too, and
without it the report names what was not run.
"""

import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

import pandas as pd

from benchmarks.paper import _uncertainty_flights as real
from benchmarks.paper import _uncertainty_simulated as simulated
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._flights_data import FOLDER
from benchmarks.paper._tasks import QUADROTOR, TASKS
from benchmarks.paper._uncertainty_figures import draw
from benchmarks.paper._uncertainty_models import FLYING, QUICK, VARIANTS, Variant
from benchmarks.paper._uncertainty_page import report

#: Measurement noise in standard deviations of each state, and more of it.
NOISE = (0.0, 0.03)
MORE_NOISE = (0.01, 0.1)
#: Process noise of the simulated quadrotor beside its own.
MORE_PROCESS = (0.0, 0.03)
#: The figure of the paper: task and fits.
EXAMPLE = {"full": ("reacher", ["P", "PE", "TP", "T"]), "quick": ("cartpole", ["P", "TP", "T"])}

Cells = list[dict[str, Any]]


def core(mode: str, seeds: list[int]) -> Cells:
    """Cells of every run; the dear ones first, so that none is left over at the end."""
    if mode == "quick":
        return [
            _cell("cartpole", noise, None, fit, mode, seed)
            for noise in NOISE
            for fit in QUICK
            for seed in seeds
        ]
    cells = [
        _cell(task, noise, None, fit, mode, seed)
        for task in reversed(TASKS)
        for fit in VARIANTS
        for noise in NOISE
        for seed in seeds
    ]
    (flying,) = QUADROTOR
    return cells + [_cell(flying, 0.0, None, fit, mode, seed) for fit in FLYING for seed in seeds]


def optional(mode: str, seeds: list[int]) -> Cells:
    """Cells that are run where they are asked for."""
    if mode == "quick":
        return []
    cells = [
        _cell(task, noise, None, fit, mode, seed)
        for task in TASKS
        for noise in MORE_NOISE
        for fit in VARIANTS
        for seed in seeds
    ]
    (flying,) = QUADROTOR
    return cells + [
        _cell(flying, 0.0, process, fit, mode, seed)
        for process in MORE_PROCESS
        for fit in FLYING
        for seed in seeds
    ]


def _cell(
    task: str, noise: float, process: float | None, fit: str, mode: str, seed: int
) -> dict[str, Any]:
    given = {"task": task, "noise": noise, "process": process, "fit": fit}
    return given | {"mode": mode, "seed": seed}


def run(run: Run, *, more: bool = False) -> Tables:
    """Scores, those behind small sets, growth, whole trajectories, the example, what was run."""
    cells = core(run.mode, run.seeds) + (optional(run.mode, run.seeds) if more else [])
    tables: dict[str, list[pd.DataFrame]] = {
        name: [] for name in ("scores", "growth", "whole", "samples", "seconds")
    }
    for asked, result in zip(cells, run.cells(cells, simulated.cell), strict=True):
        for name, some in result["variants"].items():
            key = {"task": task_name(asked), "noise": asked["noise"], "model": name}
            key |= {"seed": asked["seed"]}
            for table in ("scores", "growth", "whole", "samples"):
                if some[table]:
                    tables[table].append(pd.DataFrame([key | line for line in some[table]]))
            seconds = {"fit": result["fit_seconds"], "forecast": some["seconds"]}
            seconds["n_particles"] = _variant(asked["fit"], name).particles(run.mode)
            tables["seconds"].append(pd.DataFrame([key | seconds]))
    flown = real.run_flights(run)
    done = {name: pd.concat(some, ignore_index=True) for name, some in tables.items()}
    of_set = done["scores"]["kind"] == "set"
    done["sets"] = done["scores"][of_set].dropna(axis="columns", how="all")
    done["scores"] = done["scores"][~of_set].dropna(axis="columns", how="all")
    done["example"] = _example(run)
    if flown is not None:
        done |= {"flights": flown[0], "flights-growth": flown[1]}
    return done | {"parts": _parts(run, more=more, flown=flown is not None)}


def _variant(fit: str, name: str) -> Variant:
    return next(variant for variant in VARIANTS[fit] if variant.name == name)


def task_name(cell: dict[str, Any]) -> str:
    """Of the tables: with the process noise, where it is not that of the system."""
    if cell["process"] is None:
        return str(cell["task"])
    return f"{cell['task']}, process noise {cell['process']:g}"


def _example(run: Run) -> pd.DataFrame:
    """A line a model, state and step: truth, mean and standard deviation."""
    task, fits = EXAMPLE[run.mode]
    cell = {"task": task, "fits": fits, "mode": run.mode, "seed": run.seeds[0]}
    (result,) = run.cells([cell], simulated.example_cell)
    lines = []
    for model, some in result["forecasts"].items():
        for j, state in enumerate(result["states"]):
            values = {
                "truth": [row[j] for row in result["truth"]],
                "mean": [row[j] for row in some["mean"]],
                "std": [row[j] for row in some["std"]],
            }
            steps = range(1, len(values["truth"]) + 1)
            head = {"task": task, "episode": result["episode"], "model": model, "state": state}
            lines.append(pd.DataFrame(head | {"horizon": steps, "dt": result["dt"]} | values))
    return pd.concat(lines, ignore_index=True)


def _parts(run: Run, *, more: bool, flown: bool) -> pd.DataFrame:
    """What there is to run, and what it needs: nothing, if it was run."""
    done = core(run.mode, run.seeds) + (optional(run.mode, run.seeds) if more else [])
    ran = {_work(cell) for cell in done}
    rest = [cell for cell in core("full", run.seeds) if _work(cell) not in ran]
    extra = [cell for cell in optional("full", run.seeds) if _work(cell) not in ran]
    parts = [("nothing", done), ("full", rest), ("more", extra)]
    counts = Counter(
        (task_name(cell), cell["noise"], needs) for needs, cells in parts for cell in cells
    )
    flights = len(real.cells_of(run))
    counts["real flights", 0.0, "nothing" if flown else "data"] = flights
    left_out = len(real.cells_of(replace(run, mode="full"))) - flights
    if left_out:
        counts["real flights", 0.0, "full"] = left_out
    lines = [
        {"task": task, "noise": noise, "cells": n, "needs": needs}
        for (task, noise, needs), n in counts.items()
    ]
    return pd.DataFrame(lines)


def _work(cell: dict[str, Any]) -> tuple[Any, ...]:
    """What a cell does in any mode."""
    return tuple(value for name, value in cell.items() if name != "mode")


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "simulated": simulated.settings(mode),
        "measurement_noise": NOISE,
        "flights": real.settings(mode),
    }


BENCHMARK = Benchmark(
    "uncertainty", __doc__, run, report, draw, settings, minutes=110, data=(FOLDER,)
)


def main(arguments: list[str]) -> None:
    """The command, with the option for more cells."""
    more = "--more" in arguments
    rest = [argument for argument in arguments if argument != "--more"]
    replace(BENCHMARK, run=partial(run, more=more)).main(rest)


if __name__ == "__main__":
    main(sys.argv[1:])
