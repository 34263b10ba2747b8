"""Figures of the offline search, from its tables alone."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import legend_below
from benchmarks.paper._flights_tables import MAIN
from benchmarks.paper._offline_search_data import LATE, RANDOM
from benchmarks.paper._offline_search_ranking import USUAL
from benchmarks.paper._offline_search_rows import CHANCE, GP, RIDGE, T
from benchmarks.paper._offline_search_trials import N_INITIAL, ROWS, WITHIN
from trajlearn.plotting._style import GREY, INK, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = "os^DvP."
#: Rows whose percentiles are shaded.
_SHADED = (T, CHANCE)
_TITLES = {RANDOM: "half at random", LATE: "late half"}
#: Trials that are drawn: later, little happens.
_UNTIL = 30


def draw(tables: Tables) -> dict[str, Any]:
    """Best so far by trial, regret by model, and predicted against flown error."""
    return {
        "offline-search-trials": _trials(tables["progress"]),
        "offline-search-regret": _regret(tables["choices"]),
        "offline-search-scatter": _scatter(tables["scores"]),
    }


def _trials(progress: pd.DataFrame) -> Any:
    """A panel a group: median of the best flown error so far, by trial."""
    import matplotlib.pyplot as plt

    groups = progress["group"].unique()
    figure, axes = plt.subplots(
        1, len(groups), figsize=(4.3 * len(groups), 4.2), layout="constrained", squeeze=False
    )
    for ax, group in zip(axes[0], groups, strict=True):
        # until then all rows are the same, and far above
        shown = progress["trial"].between(N_INITIAL, _UNTIL)
        some = progress[(progress["group"] == group) & shown]
        for i, row in enumerate(ROWS):
            own = some[some["row"] == row]
            chance = {"color": INK, "linestyle": "solid"}
            style: dict[str, Any] = chance if row == CHANCE else line_style(i)
            marks = {"marker": _MARKERS[i], "ms": 4, "mfc": "white", "markevery": (i % 4, 4)}
            ax.plot(own["trial"], own["median"], lw=1.5, label=row, **marks, **style)
            if row in _SHADED:
                for q in ("q66", "q95"):
                    ax.fill_between(
                        own["trial"], own["median"], own[q], color=style["color"], alpha=0.12, lw=0
                    )
        best = progress[progress["group"] == group]["median"].min()
        ax.axhline(WITHIN * best, color=GREY, lw=1, ls="dotted")
        place = ax.get_yaxis_transform()
        ax.text(1.0, WITHIN * best, "5 % above the best", transform=place, color=GREY, fontsize=8,
                ha="right", va="bottom")  # fmt: skip
        ax.set_title(group, loc="left", fontsize=10)
        ax.set_xlabel(f"trial (experiment); the first {N_INITIAL} at random")
        ax.set_ylabel("least flown tracking error so far (mm)")
        tidy(ax)
    legend_below(figure, axes[0, 0], ncols=len(ROWS))
    return figure


def _regret(choices: pd.DataFrame) -> Any:
    """A panel a split: regret of the first choice in the median of the held-out, by group."""
    import matplotlib.pyplot as plt

    usual = choices[choices["start"] == USUAL]
    usual = usual.assign(regret=100 * (usual["chosen"] - usual["best"]) / usual["median"])
    chance = 100 * (usual["random"] - usual["best"]) / usual["median"]
    usual = usual.assign(chance=chance)
    splits = usual["split"].unique()
    rows = list(usual["row"].unique())
    groups = [MAIN, *sorted(set(usual["group"]) - {MAIN})]
    figure, axes = plt.subplots(
        1, len(splits), figsize=(3.1 * len(splits) + 1.5, 4.2), layout="constrained", sharey=True,
        sharex=True, squeeze=False,
    )  # fmt: skip
    for ax, split in zip(axes[0], splits, strict=True):
        some = usual[usual["split"] == split]
        for i, group in enumerate(groups):
            own = some[some["group"] == group]
            mean = own.groupby("row")["regret"].mean().reindex(rows)
            at = np.arange(len(rows)) + 0.17 * (i - 1.5)
            look = {"marker": _MARKERS[i], "color": line_style(i)["color"], "mfc": "white"}
            ax.plot(mean, at, ls="none", ms=6, mew=1.4, label=group, **look)
            expected = own["chance"].mean()
            ax.plot([expected], [len(rows) + 0.17 * (i - 1.5)], ls="none", ms=6, mew=1.4, **look)
        for line in np.arange(len(rows)) + 0.5:
            ax.axhline(line, color="#dddddd", lw=0.7, zorder=0)
        ax.set_yticks(range(len(rows) + 1), [*rows, "at random (expected)"])
        ax.set_title(split, loc="left", fontsize=10)
        ax.set_xlim(left=-1.5)
        ax.set_xlabel("regret (% of the median error)")
        tidy(ax)
    axes[0, 0].invert_yaxis()
    legend_below(figure, axes[0, 0], ncols=len(groups))
    return figure


def _scatter(scores: pd.DataFrame) -> Any:
    """Predicted before the flight, and flown, of the held-out experiments of the main group."""
    import matplotlib.pyplot as plt

    main = scores[scores["group"] == MAIN]
    splits = [split for split in _TITLES if (main["split"] == split).any()]
    figure, grid = plt.subplots(
        len(splits), 3, figsize=(11.5, 3.9 * len(splits)), layout="constrained", squeeze=False
    )
    for axes, split in zip(grid, splits, strict=True):
        some = main[main["split"] == split]
        # wide enough for what was flown; what was predicted far beyond is drawn at the edge
        low, high = 0.9 * some["flown"].min(), 1.15 * some["flown"].max()
        for ax, row in zip(axes, (T, RIDGE, GP), strict=True):
            _one_scatter(ax, some[some["row"] == row], low, high)
            ax.set_title(f"{row}, {_TITLES[split]}", loc="left", fontsize=10)
    legend_below(figure, grid[0, 0], ncols=3)
    return figure


def _one_scatter(ax: "Axes", own: pd.DataFrame, low: float, high: float) -> None:
    predicted = own["predicted"].clip(low, high)
    ax.scatter(
        predicted, own["flown"], s=24, facecolor="white", edgecolor=line_style(0)["color"],
        label="an experiment",
    )  # fmt: skip
    for label, row, marker in (
        ("the choice", int(own["predicted"].argmin()), "s"),
        ("the best flown", int(own["flown"].argmin()), "*"),
    ):
        color = line_style(1 if marker == "s" else 2)["color"]
        size = 90 if marker == "s" else 160
        ax.scatter(
            predicted.iloc[row], own["flown"].iloc[row], s=size, marker=marker, facecolor="none",
            edgecolor=color, lw=1.6, label=label,
        )  # fmt: skip
    ax.plot([low, high], [low, high], color=GREY, lw=1, zorder=0)
    ax.set(xlim=(low, high), ylim=(low, high))
    ax.set_xlabel("tracking error predicted from gains (mm)")
    ax.set_ylabel("flown tracking error (mm)")
    tidy(ax)
