"""Table I: predicting the reward of an episode from its first state and the controller.

Rows with the paper's settings, then tuned, then with the library's defaults; beside the paper's
models the closed-loop one-step model C, a one-step model of polynomials (cartpole is nearly
polynomial), T with a Gaussian process and with what the controller computes, and a constant.
100 training and 100 test episodes that share no seed. Every tuned row tries the same number of
configurations on a fifth of the training episodes held out, and is fitted anew on all of them.
"""

import json
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._reward_models import MAX_ROWS, QUICK_STEPS, SETTINGS, candidates
from benchmarks.paper._rewards import FAR, cell
from benchmarks.paper._tasks import N_EPISODES, TASKS

#: The figures that the paper prints: mean squared error and the std beside it.
PAPER = {
    "cartpole": {
        "GP": (0.884, 1.873),
        "NN": (0.446, 1.189),
        "D, logged actions": (0.057, 0.100),
        "D, predicted actions": (0.979, 1.725),
        "T": (0.010, 0.033),
    },
    "reacher": {
        "GP": (0.127, 0.192),
        "NN": (0.074, 0.112),
        "D, logged actions": (0.485, 2.048),
        "D, predicted actions": (0.072, 0.0932),
        "T": (0.005, 0.006),
    },
}
#: What every method needs, in the order in which they are shown.
MAPPING = {
    "GP": "(s_0, theta) -> R",
    "NN": "(s_0, theta) -> R",
    "D, logged actions": "(s_0, a_0 ... a_L) -> R",
    "D, predicted actions": "(s_0, theta, policy) -> R",
    "D, polynomial, logged actions": "(s_0, a_0 ... a_L) -> R",
    "D, polynomial, predicted actions": "(s_0, theta, policy) -> R",
    "C": "(s_0, theta) -> R",
    "T": "(s_0, theta) -> R",
    "T, features": "(s_0, theta, policy) -> R",
    "T, GP": "(s_0, theta) -> R",
    "constant": "mean training reward",
}
MODELS = {
    "paper": ["GP", "NN", "D", "T"],
    "tuned": list(SETTINGS["cartpole"]),
    "default": ["GP", "NN", "D", "D, polynomial", "C", "T", "T, features", "T, GP"],
    "-": ["constant"],
}
UNITS = {
    "cartpole": "squared error of the mean of x² + θ² (m and rad)",
    "reacher": "squared error of the mean distance (m²)",
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


# -- table ----------------------------------------------------------------------------------------


def table(task: str, records: pd.DataFrame) -> pd.DataFrame:
    """One line a method: mean over seeds of the mean squared error, its spread, medians."""
    lines = []
    for (settings, row), some in records.groupby(["settings", "row"], sort=False):
        printed = PAPER[task].get(row) if settings == "paper" else None
        lines.append(
            {
                "settings": settings,
                "method": row,
                "predicts from": MAPPING[row],
                "MSE": some["mean"].mean(),
                "MSE std over seeds": _spread(some["mean"]),
                "std of squared error": some["std"].mean(),
                "median squared error": some["median"].median(),
                "MSE, own goals": some["own_goal"].mean(),
                "episodes": int(some["n_episodes"].sum()),
                "diverged": int(some["n_diverged"].sum()),
                "lost": some["n_far"].sum(min_count=1),
                "paper": None if printed is None else f"{printed[0]:g} ± {printed[1]:g}",
                "CPU seconds": some["seconds"].mean(),
            }
        )
    frame = pd.DataFrame(lines)
    frame["lost"] = frame["lost"].astype("Int64").astype(object).where(frame["lost"].notna())
    order = {method: i for i, method in enumerate(MAPPING)}
    return frame.sort_values(
        ["settings", "method"],
        key=lambda column: column.map(order if column.name == "method" else list(MODELS).index),
        ignore_index=True,
    )


def _spread(values: pd.Series) -> float:
    """Standard deviation over seeds; unknown of one seed, and of infinite errors."""
    return values.std(ddof=1) if len(values) > 1 and np.isfinite(values).all() else np.nan


def brief(task: str, records: pd.DataFrame) -> str:
    """Compact Markdown table for the README: one line a method, one column a kind of settings."""
    frame = table(task, records).set_index(["settings", "method"])
    own_goals = bool(frame["MSE, own goals"].notna().any())

    def entry(settings: str, method: str, column: str = "MSE") -> str:
        if (settings, method) not in frame.index:
            return ""
        line = frame.loc[(settings, method)]
        if not np.isfinite(line[column]):
            lost = f"{line['diverged']} of {line['episodes']} diverge"
            return lost if line["diverged"] else ""
        if column != "MSE" or pd.isna(line["MSE std over seeds"]):
            return f"{line[column]:.2g}"
        return f"{line['MSE']:.2g} ± {line['MSE std over seeds']:.1g}"

    columns = ["paper prints"] + ["its settings, own goals"] * own_goals
    columns += ["its settings, actions aligned", "tuned", "library defaults"]
    lines = ["| method | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    known = set(frame.index.get_level_values("method"))
    for method in (method for method in MAPPING if method in known):
        printed = PAPER[task].get(method)
        cells = ["" if printed is None else f"{printed[0]:g}"]
        cells += [entry("paper", method, "MSE, own goals")] * own_goals
        last = "-" if method == "constant" else "default"
        cells += [entry(settings, method) for settings in ("paper", "tuned", last)]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def report(tables: Tables) -> str:
    """The whole table, and the short one."""
    ((task, records),) = tables.items()
    frame = table(task, records).dropna(axis="columns", how="all")
    lines = [
        f"### {task}",
        "",
        "Squared error of the mean reward per step, mean over test episodes and seeds; "
        f'"lost": forecasts that leave the training states by more than {FAR:g} of their ranges.',
    ]
    if "MSE, own goals" in frame:
        lines.append(
            '"Own goals": every test episode has a goal of its own, as in the paper; GP and NN do '
            "not see goals. Otherwise all share the environment's goal."
        )
    return "\n".join([*lines, "", markdown(frame), "", brief(task, records)])


# -- figure ---------------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """Bar plot of the table."""
    from trajlearn.plotting import plot_reward_table

    ((task, records),) = tables.items()
    frame = table(task, records)
    rows = list(zip(frame["settings"], frame["method"], strict=True))
    labels = [row if settings == "-" else f"{row} ({settings})" for settings, row in rows]
    bars = pd.DataFrame(
        {
            "mean": frame["MSE"].to_numpy(),
            "median": frame["median squared error"].to_numpy(),
            "paper": [
                PAPER[task].get(row, (np.nan,))[0] if settings == "paper" else np.nan
                for settings, row in rows
            ],
            "n_diverged": frame["diverged"].to_numpy(),
            "n_episodes": frame["episodes"].to_numpy(),
        },
        index=labels,
    )
    ax = plot_reward_table(bars)
    ax.set_xlabel(UNITS[task])
    return {task: ax.figure}


BENCHMARK = Benchmark(
    "reward-table", __doc__, run, report, draw, settings, minutes=25, tasks=tuple(TASKS)
)

if __name__ == "__main__":
    BENCHMARK.main()
