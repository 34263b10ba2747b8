"""Figures of the study of uncertainty, from its tables alone."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import legend_below
from benchmarks.paper._uncertainty_tables import LOGGED, at, observed, place, steps
from benchmarks.paper._uncertainty_target import TARGET
from trajlearn.plotting._style import GREY, INK, line_style, tidy

#: Models of the figures of all tasks; the others are in the tables.
SHOWN = ["P", "PE", "T", "TP", "TPE", "LSTM", "GP, sparse"]
#: Models of the figure of the paper, and of the growth.
COMPARED = [f"P, {LOGGED}", "P", "PE", "TP", "T"]
_STYLED = [*SHOWN, f"P, {LOGGED}"]
_MARKERS = "os^DvP*X"
_UNITS = {"velocity": "rad/s", "x_dot": "m/s", "theta_dot": "rad/s", "x": "m", "theta": "rad"}


def draw(tables: Tables) -> dict[str, Any]:
    """Coverage, CRPS, growth, one episode, and the real flights."""
    main = observed(tables["scores"])
    main = main[main["model"].isin(SHOWN)]
    figures = {
        "uncertainty-coverage": _draw_coverage(main),
        "uncertainty-crps": _draw_crps(main),
        "uncertainty-growth": _draw_growth(tables["growth"]),
        "uncertainty-example": _draw_example(tables["example"]),
    }
    if "flights" in tables:
        flights = tables["flights"].assign(task="real", noise=0.0)
        figures["uncertainty-flights"] = _draw_flights(flights)
    return figures


def _places(table: pd.DataFrame) -> list[tuple[str, float]]:
    return list(table[["task", "noise"]].drop_duplicates().itertuples(index=False, name=None))


def _look(model: str) -> dict[str, Any]:
    """The style of a model in all figures."""
    i = _STYLED.index(model)
    return {"marker": _MARKERS[i], "mfc": "white"} | line_style(i)


def _lines(
    ax: Any,
    some: pd.DataFrame,
    column: str,
    unit: float = 1.0,
    *,
    bars: tuple[str, str] | None = None,
) -> None:
    """A line a model over the bins: mean over seeds, with bars from least to greatest.

    Or with bars between two columns.
    """
    bins = some[["first", "last"]].drop_duplicates().sort_values("first")
    x = np.arange(len(bins))
    models = [model for model in SHOWN if (some["model"] == model).any()]
    for i, model in enumerate(models):
        by = some[some["model"] == model].groupby("first")
        middle = by[column].mean().to_numpy() * unit
        ends = (column, column) if bars is None else bars
        low, high = by[ends[0]].min().to_numpy() * unit, by[ends[1]].max().to_numpy() * unit
        shift = (i - (len(models) - 1) / 2) * 0.07
        ax.errorbar(
            x + shift,
            middle,
            # a bootstrap interval need not hold the mean
            yerr=np.maximum([middle - low, high - middle], 0.0),
            ms=5,
            lw=1.2,
            elinewidth=0.8,
            label=model,
            **_look(model),
        )
    labels = [steps(first, last) for first, last in bins.itertuples(index=False)]
    ax.set_xticks(x, labels)
    ax.set_xlabel("horizon (steps)")
    tidy(ax)


def _target_band(ax: Any) -> None:
    ax.axhspan(*TARGET, color=GREY, alpha=0.25, lw=0)
    ax.axhline(0.9, color=GREY, lw=0.8)


def _draw_coverage(main: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    places = _places(main)
    figure, grid = plt.subplots(
        len(places), 2, figsize=(9.5, 2.6 * len(places)), layout="constrained", squeeze=False
    )
    for axes, (task, noise) in zip(grid, places, strict=True):
        some = at(main, task, noise)
        for ax, kind in zip(axes, ("raw", "conformal"), strict=True):
            _target_band(ax)
            few = some[some["kind"] == kind]
            _lines(ax, few, "coverage90")
            least = few["coverage90"].min() - 0.01
            ax.set_ylim(*((0.0, 1.02) if kind == "raw" else (min(0.78, least), 1.0)))
            ax.set_ylabel("coverage of 90 %")
            ax.set_title(f"{place(task, noise)}: {kind}", loc="left", fontsize=10)
    first = max(grid[:, 0], key=lambda ax: len(ax.get_legend_handles_labels()[1]))
    legend_below(figure, first, ncols=len(SHOWN))
    return figure


def _draw_crps(main: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    places = _places(main)
    n_rows = -(-len(places) // 2)
    figure, grid = plt.subplots(
        n_rows, 2, figsize=(9.5, 3.0 * n_rows), layout="constrained", squeeze=False
    )
    for ax in grid.ravel()[len(places) :]:
        ax.set_visible(False)
    for ax, (task, noise) in zip(grid.ravel(), places, strict=False):
        some = at(main, task, noise)
        _lines(ax, some[some["kind"] == "conformal"], "crps", 1000)
        ax.set_yscale("log")
        ax.set_ylabel("CRPS x 1000\n(training ranges)")
        ax.set_title(f"{place(task, noise)}, calibrated", loc="left", fontsize=10)
    first = max(grid.ravel(), key=lambda ax: len(ax.get_legend_handles_labels()[1]))
    legend_below(figure, first, ncols=len(SHOWN))
    return figure


def _draw_growth(growth: pd.DataFrame) -> Any:
    """Std and error over the horizon: parallel lines are honest."""
    import matplotlib.pyplot as plt

    places = _places(growth)
    models = [model for model in COMPARED if (growth["model"] == model).any()]
    figure, grid = plt.subplots(
        len(places),
        len(models),
        figsize=(2.3 * len(models) + 0.6, 2.2 * len(places) + 0.4),
        layout="constrained",
        squeeze=False,
        sharex=True,
        sharey="row",
    )
    for axes, (task, noise) in zip(grid, places, strict=True):
        some = at(growth, task, noise)
        for ax, model in zip(axes, models, strict=True):
            few = some[some["model"] == model]
            ax.set_visible(len(few) > 0)
            if len(few):
                _draw_grown(ax, few)
                ax.set_title(model, loc="left", fontsize=9)
        axes[0].set_ylabel(f"{place(task, noise)}\n(training ranges)", fontsize=8)
    for column in grid.T:
        lowest = [ax for ax in column if ax.get_visible()][-1]
        lowest.tick_params(labelbottom=True)
        lowest.set_xlabel("horizon (steps)")
    legend_below(figure, grid[0, 0], ncols=2)
    return figure


def _draw_grown(ax: Any, few: pd.DataFrame) -> None:
    # neither looks like a model
    looks = {
        "std": {"color": INK, "linestyle": "solid", "marker": "o", "label": "predicted std"},
        "error": {"color": GREY, "linestyle": "dashed", "marker": "s", "label": "error"},
    }
    for column, look in looks.items():
        by = few.groupby("horizon")[column]
        middle = by.median()
        ax.plot(middle.index, middle, ms=3.5, lw=1.4, mfc="white", **look)
        ax.fill_between(middle.index, by.min(), by.max(), color=look["color"], alpha=0.15, lw=0)
    ax.set_xscale("log")
    ax.set_yscale("log")
    tidy(ax)


def _draw_example(example: pd.DataFrame) -> Any:
    """States with two standard deviations, by model; below, the standard deviations."""
    import matplotlib.pyplot as plt

    states = list(example["state"].unique())
    models = [model for model in COMPARED if (example["model"] == model).any()]
    figure, grid = plt.subplots(
        len(states),
        len(models) + 1,
        figsize=(2.5 * (len(models) + 1), 2.1 * len(states) + 0.5),
        layout="constrained",
        squeeze=False,
        sharex=True,
    )
    for axes, state in zip(grid, states, strict=True):
        some = example[example["state"] == state]
        truth = some[some["model"] == models[0]]
        span = np.ptp(truth["truth"]) or 1.0
        limits = (truth["truth"].min() - span, truth["truth"].max() + span)
        for ax, model in zip(axes, models, strict=False):
            few = some[some["model"] == model]
            time = few["horizon"] * few["dt"]
            mean, std = few["mean"], few["std"]
            ax.fill_between(
                time,
                mean - 2 * std,
                mean + 2 * std,
                color=GREY,
                alpha=0.35,
                lw=0,
                label="mean ± 2 std",
            )
            # its look is in the legend, from the standard deviations
            ax.plot(time, mean, color=_look(model)["color"], lw=1.2)
            ax.plot(time, few["truth"], color=INK, lw=1.2, ls="dashed", label="simulated")
            ax.set_ylim(*limits)
            tidy(ax)
            if state == states[0]:
                ax.set_title(model, loc="left", fontsize=9)
        last = axes[-1]
        for i, model in enumerate(models):
            few = some[some["model"] == model]
            last.plot(
                few["horizon"] * few["dt"],
                few["std"],
                lw=1.3,
                label=model,
                markevery=(5 + 7 * i, 40),
                ms=4,
                **_look(model),
            )
        last.set_yscale("log")
        last.set_ylabel(f"std [{unit_of(state)}]", fontsize=8)
        tidy(last)
        axes[0].set_ylabel(f"{state.replace('_', ' ')} [{unit_of(state)}]", fontsize=8)
    grid[0, -1].set_title("standard deviations", loc="left", fontsize=9)
    for ax in grid[-1]:
        ax.set_xlabel("time [s]")
    legend_below(figure, grid[0, 0], ncols=4, others=[grid[0, -1]])
    return figure


def unit_of(state: str) -> str:
    """Unit of a state of the simulators; cosines and sines have none."""
    kind = state.split("_")[0]
    return _UNITS.get(state, _UNITS.get(kind, "1") if kind == "velocity" else "1")


def _draw_flights(flights: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    for ax, kind in zip(axes, ("raw", "conformal"), strict=False):
        _target_band(ax)
        _lines(ax, flights[flights["kind"] == kind], "coverage90", bars=("low", "high"))
        ax.set_ylabel("coverage of 90 %")
        ax.set_title(f"real flights: {kind}", loc="left", fontsize=10)
    for ax in axes[:2]:
        ax.set_ylim(min(a.get_ylim()[0] for a in axes[:2]), 1.01)
    _lines(axes[2], flights[flights["kind"] == "conformal"], "crps", 1000)
    axes[2].set_yscale("log")
    axes[2].set_ylabel("CRPS x 1000 (training ranges)")
    axes[2].set_title("real flights, calibrated", loc="left", fontsize=10)
    legend_below(figure, axes[0], ncols=len(SHOWN))
    return figure
