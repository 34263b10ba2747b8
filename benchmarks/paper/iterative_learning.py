"""Learning the parameters of a controller in a few trials: T against Bayesian optimisation.

After every trial a model is fitted anew, the best theta is searched in it and tried next. T with
CMA-ES and with gradients, one-step models, a direct Gaussian process, Bayesian optimisation and
random search share first trial, initial states and number of trials. The best return so far by
trial, median over 25 repeats on cartpole (ten on reacher), with the ranges of 66 % and 95 %.
(The paper: its figure of iterative learning, T and Bayesian optimisation on cartpole.)
"""

import json
from typing import Any

import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._control_tasks import CONTROL_TASKS, FACTORS, best_known
from benchmarks.paper._iterative_figures import draw
from benchmarks.paper._iterative_methods import (
    CLIP,
    EVERY,
    METHODS,
    N_PLANNED,
    N_SAMPLES,
    OF_TASK,
    PAPER_ROWS,
    SIZES,
    TEACHER,
    WIDTHS,
    repeat,
)
from benchmarks.paper._iterative_page import report

N_REPEATS = {"cartpole": 25, "reacher": 10}


def run(run: Run) -> Tables:
    """One line a trial, and the scale of the task."""
    assert run.task is not None
    [scale] = run.cells([{"task": run.task, "mode": run.mode}], best_known)
    cells = [
        {"task": run.task, "method": method, "repeat": number, "mode": run.mode}
        for number in run.seeds[: N_REPEATS[run.task]]
        for method in OF_TASK[run.task]
    ]
    trials = pd.DataFrame([line for lines in run.cells(cells, repeat) for line in lines])
    one = pd.DataFrame([scale | {"params": json.dumps(scale["params"])}])
    return {run.task: trials, f"{run.task}-scale": one}


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""

    def size(value: Any, name: str) -> Any:
        return value[name] if isinstance(value, dict) else value

    return {
        name: {
            "task": name,
            "length": task.length,
            "bounds": task.bounds.tolist(),
            "terminal_reward": task.terminal_reward,
            "n_repeats_at_most": N_REPEATS[name],
            "n_test_starts": len(task.test_starts),
            "n_planned_starts": N_PLANNED[name],
            "every": EVERY[name],
            "n_samples": N_SAMPLES,
            "clip_states": CLIP,
            "widths_of_t": WIDTHS,
            "teacher": TEACHER[name],
            "paper_rows": PAPER_ROWS,
            "methods": {method: METHODS[method] for method in OF_TASK[name]},
            **({"factors_of_lqr_gain": FACTORS} if name == "cartpole" else {}),
            **{f"n_{what}": size(value, name) for what, value in SIZES[mode].items()},
        }
        for name, task in CONTROL_TASKS.items()
    }


BENCHMARK = Benchmark(
    "iterative-learning",
    __doc__,
    run,
    report,
    draw,
    settings,
    minutes=45,
    seeds=25,
    tasks=tuple(CONTROL_TASKS),
)

if __name__ == "__main__":
    BENCHMARK.main()
