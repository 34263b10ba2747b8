"""Prediction error by horizon on cartpole and reacher: the paper's main comparison.

D, PE, LSTM and T with the paper's settings, and T, T with the controller's features, C (closed
loop), D and LSTM with ours, on 100 test episodes that are twice as long as the training episodes.
One-step and recurrent models are rolled out with logged actions, as the paper does, and with
actions that the policy recomputes from predicted states: all there is before an episode is run.
Median, 65th and 95th percentile over episodes. (The paper: its figure of prediction errors,
panels a and b.)
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import draw_curve, horizon_axes, legend_below, over_seeds
from benchmarks.paper._intervals import by_seed, ratio, rounded, spread
from benchmarks.paper._rollouts import N_TEST, measure, windows
from benchmarks.paper._tasks import N_EPISODES, TASKS
from trajlearn.plotting._style import GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAPER = ["D", "PE", "LSTM", "T"]
OURS = ["T", "T, features", "C", "D", "LSTM"]
WINDOWS = ["short", "long", "beyond"]
ACTIONS = {"none": "", "logged": ", logged", "policy": ", recomputed"}
# look of a line: a model has the same in every figure
STYLES = {"D": 0, "PE": 1, "LSTM": 2, "T": 3, "T (ours)": 4, "C (ours)": 5, "T, features (ours)": 6}


def run(run: Run) -> Tables:
    """Curves and errors by episode of all models."""
    models = [(model, "paper") for model in PAPER] + [(model, "default") for model in OURS]
    tables = measure(run, list(TASKS), models)
    # what no text or figure here needs: the files are committed
    return {
        "curves": tables["curves"].drop(columns="mean"),
        "episodes": tables["episodes"].drop(columns=["within", "reward"]),
    }


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    models = {"paper": PAPER, "default": OURS}
    return {"models": models, "n_train": N_EPISODES, "n_test": N_TEST[mode], "tasks": TASKS}


# -- text ---------------------------------------------------------------------------------


def report(tables: Tables) -> str:
    """Median error in windows of horizons, and which model is best in which."""
    lines = [
        "Squared error in units of the training range: mean over a window of horizons (steps), "
        "median over test episodes, median over seeds (least to greatest). Diverged: episodes "
        "whose error is infinite, of all episodes of all seeds. Names without (ours) have the "
        "paper's settings. Behind a ratio of errors: its 95 % interval over test episodes.",
        "",
    ]
    for task, some in tables["episodes"].groupby("task", sort=False):
        lines += [f"### {task}", "", markdown(summary(some, str(task))), ""]
        named = some.assign(model=named_models(some))
        as_paper = named[~ours(some) & (some["actions"] != "policy")]
        lines += ["The paper's comparison (its settings, logged actions):", ""]
        lines += [*best(as_paper, str(task)), ""]
        lines += ["Without logged actions, all settings:", ""]
        lines += [*best(named[some["actions"] != "logged"], str(task)), ""]
    return "\n".join(lines)


def summary(episodes: pd.DataFrame, task: str) -> pd.DataFrame:
    """A line a model and source of actions, a column a window of horizons.

    Parameters
    ----------
    episodes : DataFrame
        Of one task, as from `measure`.
    task : str
    """
    titles = window_titles(task)
    lines = []
    for (model, actions), some in episodes.groupby(["model", "actions"], sort=False):
        line = {"model": model, "actions": actions}
        medians = some.groupby("seed")[WINDOWS].median()
        line |= {titles[window]: spread(medians[window]) for window in WINDOWS}
        diverged = np.isinf(some[WINDOWS]).any(axis=1)
        lines.append(line | {"diverged": f"{diverged.sum()} of {len(some)}"})
    return pd.DataFrame(lines)


def best(episodes: pd.DataFrame, task: str) -> list[str]:
    """A line a window: the best model, and how many times its error others have.

    Of many others, the runner-up and the trajectory models, wherever they stand.
    """
    by_model = dict(list(episodes.groupby("model", sort=False)))
    lines = []
    for window, title in window_titles(task).items():
        errors = {model: by_seed(some, window) for model, some in by_model.items()}
        middle = {m: np.median([np.median(e) for e in some]) for m, some in errors.items()}
        first, *others = sorted(errors, key=lambda model: middle[model])
        if np.isinf(middle[first]):
            lines.append(f"- {title}: every model diverges.")
            continue
        few = len(errors) <= len(PAPER)
        named = [m for i, m in enumerate(others) if few or i == 0 or m.startswith("T")]
        text = "; ".join(f"{m} {_times(errors[m], errors[first])}" for m in named)
        least = rounded(middle[first])
        lines.append(f"- {title}: best is {first}, {least}. Times its error: {text}.")
    return lines


def _times(errors: Any, reference: Any) -> str:
    estimate, low, high = ratio(errors, reference)
    if np.isinf(estimate):
        return "diverges"
    doubt = ", not told apart" if low <= 1 <= high else ""
    return f"{rounded(estimate)} ({rounded(low)} to {rounded(high)}{doubt})"


def window_titles(task: str) -> dict[str, str]:
    """Windows of horizons as columns of a table, such as "short, 1-25"."""
    shape = TASKS[task]
    steps = np.arange(1, shape.test_length + 1)
    of = {window: steps[where] for window, where in windows(shape.length).items()}
    return {window: f"{window}, {of[window][0]}-{of[window][-1]}" for window in WINDOWS}


def ours(table: pd.DataFrame) -> "pd.Series[bool]":
    """Which lines of a table have our settings."""
    return table["model"].str.endswith("(ours)")


def named_models(table: pd.DataFrame) -> "pd.Series[str]":
    """Models with their source of actions, such as "D, logged"."""
    return table["model"] + table["actions"].map(ACTIONS)


# -- figures ------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """The paper's comparison, and the one without logged actions."""
    curves = tables["curves"]
    models = curves["model"].unique()
    styles = {m: STYLES[m if m in STYLES else m.removesuffix(" (ours)")] for m in models}
    curves = curves.assign(line=named_models(curves), style=curves["model"].map(styles))
    paper, logged = ~ours(curves), curves["actions"] == "logged"
    as_paper = curves[paper & (curves["actions"] != "policy")]
    fair = curves[(~paper & ~logged) | (curves["model"] == "T")]
    fair = fair.replace({"line": {"T": "T (paper)"}})
    return {
        "horizon-error-paper": draw_lines(as_paper, percentiles=True),
        "horizon-error-ours": draw_lines(fair, percentiles=False),
    }


def draw_lines(curves: pd.DataFrame, *, percentiles: bool) -> Any:
    """A column a task, a row a scale of the horizon: linear, and logarithmic for the first steps.

    Parameters
    ----------
    curves : DataFrame
        As from `measure`, with the columns ``line`` (name in the legend) and ``style`` (number).
    percentiles : bool
        Shade up to the 65th and 95th percentile over episodes; else from the least to the
        greatest median over seeds.
    """
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(
        2, len(TASKS), figsize=(9.5, 7.0), layout="constrained", sharey="col", squeeze=False
    )
    for axes, (task, shape) in zip(grid.T, TASKS.items(), strict=True):
        chosen = curves[curves["task"] == task]
        for ax, scale in zip(axes, ("linear", "log"), strict=True):
            for (line, style), curve in chosen.groupby(["line", "style"], sort=False):
                _draw_line(ax, curve, style, line, percentiles=percentiles)
            if scale == "linear":
                horizon_axes(ax, title=task, length=shape.length)
            else:
                ax.axvline(shape.length, color=GREY, lw=1, ls="dotted")
                horizon_axes(ax, title=f"{task}, logarithmic horizon")
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter("{x:g}")
    legend_below(figure, grid[0, 0], ncols=4 if curves["line"].nunique() <= 4 else 3)
    return figure


def _draw_line(ax: "Axes", curve: pd.DataFrame, i: int, label: str, *, percentiles: bool) -> None:
    over = over_seeds(curve, ["horizon"])
    if not percentiles:
        draw_curve(ax, over, i, label, band=("low", "high"))
        return
    for q in ("q65", "q95"):
        over[q] = over_seeds(curve, ["horizon"], q)["middle"]
    draw_curve(ax, over, i, label, band=("middle", "q65"))
    draw_curve(ax, over, i, "", band=("middle", "q95"))


BENCHMARK = Benchmark("horizon-error", __doc__, run, report, draw, settings, minutes=20)

if __name__ == "__main__":
    BENCHMARK.main()
