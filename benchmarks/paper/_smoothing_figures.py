"""Figures of the smoothing benchmark, from its tables alone."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import ERROR, share_y
from benchmarks.paper._smoothing_page import LABELS, in_noise, percent, steps_of
from benchmarks.paper.horizon_error import named_models
from trajlearn.plotting._style import GREY, line_style, tidy

# times another error: too far away for the same axis
_APART = 1e3
_TICKS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20]


def draw(tables: Tables) -> dict[str, Any]:
    """States by noise; forecasts by noise, one figure a window of horizons."""
    errors = tables["errors"].assign(line=named_models(tables["errors"]))
    figures = {
        f"smoothing-{window}": _draw_forecasts(some, str(window))
        for window, some in errors.groupby("window", sort=False)
    }
    return {"smoothing-states": _draw_states(tables["states"])} | figures


def _draw_states(states: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    some = in_noise(states[states["used"] & (states["noise"] > 0)])
    tasks, noises = some["task"].unique(), np.sort(some["noise"].unique())
    figure, grid = plt.subplots(
        len(tasks),
        len(noises),
        figsize=(1.5 + 3.6 * len(noises), 2.9 * len(tasks)),
        layout="constrained",
        sharey=True,
        squeeze=False,
    )
    for axes, task in zip(grid, tasks, strict=True):
        of_task = some[some["task"] == task]
        for ax, noise in zip(axes, noises, strict=True):
            few = of_task[of_task["noise"] == noise]
            names = list(few["state"].unique())
            x = np.arange(len(names))
            for i, column in enumerate(("filtered", "smoothed")):
                over = few.groupby("state", sort=False)[column].agg(["median", "min", "max"])
                middle = over["median"].to_numpy()
                error = np.abs(over[["min", "max"]].to_numpy().T - middle)
                colour = line_style(i)["color"]
                look = {"color": colour, "marker": "os"[i], "mfc": ["white", colour][i], "ms": 5}
                at = x + 0.3 * (i - 0.5)
                ax.errorbar(at, middle, error, ls="", capsize=2, label=column, **look)
            ax.axhline(1, color=GREY, lw=1, ls="dashed", label="measured")
            ax.set_yscale("log")
            ax.set_xlim(-0.6, len(names) - 0.4)
            ax.set_xticks(x, names, rotation=90 if len(names) > 8 else 0, fontsize=8)
            (smoother,) = few["smoother"].unique()
            title = f"{task}, {percent(noise)} noise\n({smoother})"
            ax.set_title(title, loc="left", fontsize=10)
            tidy(ax)
        axes[0].set_ylabel("error of state / noise")
    # panels share this axis
    low, high = grid[0, 0].get_ylim()
    grid[0, 0].set_yticks([tick for tick in _TICKS if low < tick < high])
    grid[0, 0].yaxis.set_major_formatter("{x:g}")
    grid[0, 0].yaxis.set_minor_locator(NullLocator())
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_forecasts(errors: pd.DataFrame, window: str) -> Any:
    import matplotlib.pyplot as plt

    lines = list(errors["line"].unique())
    rows = list(errors[["task", "start"]].drop_duplicates().itertuples(index=False, name=None))
    figure, grid = plt.subplots(
        len(rows),
        len(lines),
        figsize=(1 + 2.7 * len(lines), 0.6 + 2.6 * len(rows)),
        layout="constrained",
        sharex=True,
        squeeze=False,
    )
    noises = np.sort(errors["noise"].unique())
    for axes, (task, start) in zip(grid, rows, strict=True):
        of_row = errors[(errors["task"] == task) & (errors["start"] == start)]
        for ax, line in zip(axes, lines, strict=True):
            for i, (states, label) in enumerate(LABELS.items()):
                few = of_row[(of_row["line"] == line) & (of_row["states"] == states)]
                over = few.groupby("noise")["median"].agg(["median", "min", "max"])
                over = over.clip(upper=1e12)
                _draw_line(ax, np.searchsorted(noises, over.index), over, i, label)
            ax.set_yscale("log")
            ax.set_xticks(range(len(noises)), [f"{100 * noise:g}" for noise in noises])
            ax.set_title(f"{line}, from state {start}", loc="left", fontsize=9)
            tidy(ax)
        axes[0].set_ylabel(f"{task}, from state {start}\n{ERROR}", fontsize=9)
        # on an unstable plant errors with logged actions are of another size
        top = np.array([ax.get_ylim()[1] for ax in axes])
        others = np.array(["logged" not in line for line in lines])
        far = top[~others].max(initial=0) > _APART * top[others].max()
        shared = [ax for ax, other in zip(axes, others, strict=True) if other or not far]
        share_y(shared)
        for ax in shared:
            low, high = ax.get_ylim()
            ax.set_ylim(low / 1.5, high * 1.5)
    for ax in grid[-1]:
        ax.set_xlabel("noise (% of the state's std)")
    shown = " and ".join(f"{steps_of(window, task)} on {task}" for task in errors["task"].unique())
    figure.suptitle(f"Horizons {shown}", fontsize=10)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    title = "trained on states that are"
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, title=title)
    return figure


def _draw_line(ax: Any, x: NDArray[Any], over: pd.DataFrame, i: int, label: str) -> None:
    style = line_style(i)
    marker = {"marker": "os^"[i], "ms": 5, "mfc": "white"}
    ax.plot(x, over["median"], lw=1.5, label=label, **marker, **style)
    ax.fill_between(x, over["min"], over["max"], color=style["color"], alpha=0.15, lw=0)
