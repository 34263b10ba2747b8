"""The eight feed-forward models of the paper, on cartpole and reacher.

D, P, DE and PE rolled out with logged and with recomputed actions, T, TP, TE and TPE in one
evaluation; the paper's settings, actions aligned. Median error over 100 test episodes that are
twice as long as the training episodes. (The paper: its figure of all models, reacher only.)
"""

from typing import Any

import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import draw_curve, horizon_axes, legend_below, over_seeds, share_y
from benchmarks.paper._rollouts import N_TEST, measure
from benchmarks.paper._tasks import N_EPISODES, TASKS

MODELS = ["D", "P", "DE", "PE", "T", "TP", "TE", "TPE"]


def run(run: Run) -> Tables:
    """Curves and errors by episode of all models."""
    return measure(run, list(TASKS), [(model, "paper") for model in MODELS])


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {"models": MODELS, "n_train": N_EPISODES, "n_test": N_TEST[mode], "tasks": TASKS}


def report(tables: Tables) -> str:
    """Median error in windows of horizons."""
    lines = ["Median over test episodes of the mean squared error in a window of horizons,"]
    lines += ["median over seeds (least to greatest).", ""]
    for task, some in tables["episodes"].groupby("task", sort=False):
        lines += [f"### {task}", "", markdown(_summary(some)), ""]
    return "\n".join(lines)


def _summary(episodes: pd.DataFrame) -> pd.DataFrame:
    windows = ["short", "long", "beyond"]
    medians = episodes.groupby(["model", "actions", "seed"], sort=False)[windows].median()
    lines = []
    for (model, actions), some in medians.groupby(level=[0, 1], sort=False):
        line = {"model": model, "actions": actions}
        for window in windows:
            values = some[window]
            spread = f"{values.min():.1g} to {values.max():.1g}"
            line[window] = f"{values.median():.2g} ({spread})"
        lines.append(line)
    return pd.DataFrame(lines)


def draw(tables: Tables) -> dict[str, Any]:
    """A panel a task and a way to get actions."""
    import matplotlib.pyplot as plt

    curves = tables["curves"]
    figure, grid = plt.subplots(
        len(TASKS), 2, figsize=(9.5, 3.6 * len(TASKS)), layout="constrained", squeeze=False
    )
    for axes, (task, shape) in zip(grid, TASKS.items()):
        for ax, actions in zip(axes, ("logged", "policy")):
            chosen = curves[(curves["task"] == task) & curves["actions"].isin([actions, "none"])]
            for i, model in enumerate(MODELS):
                curve = over_seeds(chosen[chosen["model"] == model], ["horizon"])
                draw_curve(ax, curve, i, model, band=("low", "high"))
            how = "logged" if actions == "logged" else "recomputed"
            horizon_axes(ax, title=f"{task}, one-step: {how} actions", length=shape.length)
        share_y(axes)
    legend_below(figure, grid[0, 0], ncols=8)
    return {"all-models": figure}


BENCHMARK = Benchmark("all-models", __doc__, run, report, draw, settings, minutes=15)

if __name__ == "__main__":
    BENCHMARK.main()
