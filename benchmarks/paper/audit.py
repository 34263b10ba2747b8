"""The paper's claims one by one: what it says, what was measured, and a verdict.

Runs the ablations of the paper's protocol (late actions, scoring on training episodes, an N x N
difference, an untrained network, unequal budgets), and reads the stored results of the other
benchmarks of this folder: run those first. Writes docs/audit.md from a full run.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._ablations import (
    GP_SHARE,
    NN_STEPS,
    all_pairs_error,
    budget_cell,
    late_cell,
    plan,
    planning_cell,
    reward_cell,
    untrained_cell,
)
from benchmarks.paper._command import Run, Tables
from benchmarks.paper._rollouts import N_TEST
from benchmarks.paper._tasks import N_EPISODES, TASKS

DOCS = Path(__file__).parents[2] / "docs" / "audit.md"
#: Benchmarks whose stored tables the audit reads.
SOURCES = (
    "horizon-error",
    "action-source",
    "all-models",
    "data-types",
    "sample-efficiency",
    "continuous-time",
    "reward-table",
)


def run(run: Run) -> Tables:
    """Tables of the ablations."""
    results = {
        function: list(zip(cells, run.cells(cells, function), strict=True))
        for function, cells in plan(run.mode, run.seeds).items()
    }
    return {
        "rewards": _rewards(results[reward_cell]),
        "late": _by_episode(results[late_cell]),
        "budget": _by_episode(results[budget_cell]),
        "untrained": _rewards(results[untrained_cell]),
        "planning": pd.DataFrame(
            {"candidates": asked["candidates"], "seed": asked["seed"], "way": way, "seconds": taken}
            for asked, result in results[planning_cell]
            for way, taken in result.items()
        ),
    }


Results = list[tuple[dict[str, Any], Any]]


def _rewards(results: Results) -> pd.DataFrame:
    """A line a fit and set of episodes: the squared error, and that of all pairs."""
    lines = []
    for asked, result in results:
        for name, some in result.items():
            estimate, truth = (np.asarray(some[key], float) for key in ("estimate", "truth"))
            scored_on, _, actions = name.partition(", ")
            line = {key: value for key, value in asked.items() if key != "mode"}
            line |= {"scored_on": scored_on, "actions": actions or "none"}
            line["error"] = float(np.mean((estimate - truth) ** 2))
            line["all_pairs"] = all_pairs_error(estimate, truth)
            lines.append(line | {"variance": float(truth.var())})
    return pd.DataFrame(lines)


def _by_episode(results: Results) -> pd.DataFrame:
    """A line a test episode, with its mean error in each window."""
    tables = []
    for asked, result in results:
        for actions, windows in result.items():
            line = {key: value for key, value in asked.items() if key != "mode"}
            n = len(windows["within"])
            table = line | {"actions": actions, "episode": range(n)} | windows
            tables.append(pd.DataFrame(table))
    return pd.concat(tables, ignore_index=True)


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "tasks": TASKS,
        "gp_share": GP_SHARE,
        "nn_steps": NN_STEPS[mode],
    }
