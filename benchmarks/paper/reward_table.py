"""Table I: predicting the reward of an episode from its first state and the controller.

Rows with the paper's settings, then tuned, then with the library's defaults; beside the paper's
models the closed-loop one-step model C, a one-step model of polynomials (cartpole is nearly
polynomial), T with a Gaussian process and with what the controller computes, and a constant.
100 training and 100 test episodes that share no seed. Every tuned row tries the same number of
configurations on a fifth of the training episodes held out, and is fitted anew on all of them.
"""

import json
from typing import Any

import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._reward_models import MAX_ROWS, QUICK_STEPS, SETTINGS, candidates
from benchmarks.paper._reward_page import draw, report
from benchmarks.paper._rewards import cell
from benchmarks.paper._tasks import N_EPISODES, TASKS

MODELS = {
    "paper": ["GP", "NN", "D", "T"],
    "tuned": list(SETTINGS["cartpole"]),
    "default": ["GP", "NN", "D", "D, polynomial", "C", "T", "T, features", "T, GP"],
    "-": ["constant"],
}


def run(run: Run) -> Tables:
    """One line a row of the table and seed."""
    assert run.task is not None
    cells = [
        {"task": run.task, "model": model, "settings": settings, "mode": run.mode, "seed": seed}
        for settings, models in MODELS.items()
        for model in models
        for seed in run.seeds
    ]
    lines = [line for lines in run.cells(cells, cell) for line in lines]
    records = pd.DataFrame(lines)
    return {run.task: records.assign(config=[json.dumps(line["config"]) for line in lines])}


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        task: {
            "task": task,
            "n_train": N_EPISODES,
            "n_test": N_EPISODES,
            "length": TASKS[task].length,
            "max_steps": None if mode == "full" else QUICK_STEPS,
            "max_rows": {name: n for (of, name), n in MAX_ROWS[mode].items() if of == task},
            "candidates": {model: candidates(task, model) for model in SETTINGS[task]},
        }
        for task in TASKS
    }


BENCHMARK = Benchmark(
    "reward-table", __doc__, run, report, draw, settings, minutes=20, tasks=tuple(TASKS)
)

if __name__ == "__main__":
    BENCHMARK.main()
