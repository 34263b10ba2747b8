"""Looks that the figures of this folder share: readable in grey, log errors, axes with units."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from trajlearn.plotting._style import GREY, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ERROR = "squared error (training range = 1)"
#: Greatest error that is drawn.
CEILING = 100.0
_MARKERS = "os^DvP*X"


def over_seeds(curves: pd.DataFrame, by: list[str], column: str = "median") -> pd.DataFrame:
    """Median, least and greatest of a column over seeds, for every value of `by`."""
    grouped = curves.groupby(by, sort=False)[column]
    return grouped.agg(middle="median", low="min", high="max").reset_index()


def draw_curve(
    ax: "Axes", curve: pd.DataFrame, i: int, label: str, *, band: tuple[str, str] | None
) -> None:
    """One line over the horizon in the i-th style, with a band between two columns."""
    style: dict[str, Any] = line_style(i)
    horizon = curve["horizon"].to_numpy()
    # markers here and there, staggered, tell the lines apart without colour
    marks = {"marker": _MARKERS[i % len(_MARKERS)], "ms": 4, "mew": 1, "mfc": "white"}
    every = (i % 4 + 4, 8)
    shown = curve["middle"].clip(upper=1e12)
    ax.plot(horizon, shown, lw=1.5, label=label, markevery=every, **marks, **style)
    if band is not None:
        low, high = (curve[column].clip(upper=1e12) for column in band)
        ax.fill_between(horizon, low, high, color=style["color"], alpha=0.13, lw=0)


def draw_percentiles(ax: "Axes", curve: pd.DataFrame, i: int, label: str) -> None:
    """One line, shaded up to the 65th and 95th percentile; of each the median over seeds."""
    over = over_seeds(curve, ["horizon"])
    for q in ("q65", "q95"):
        over[q] = over_seeds(curve, ["horizon"], q)["middle"]
    draw_curve(ax, over, i, label, band=("middle", "q65"))
    draw_curve(ax, over, i, "", band=("middle", "q95"))


def horizon_axes(ax: "Axes", *, title: str, length: int | None = None, unit: str = "steps") -> None:
    """Logarithmic in the error, with the training length marked."""
    ax.set_yscale("log", nonpositive="mask")
    ax.set_ylim(top=min(ax.get_ylim()[1], CEILING))
    if length is not None:
        ax.axvline(length, color=GREY, lw=1, ls="dotted")
        at = ax.get_xaxis_transform()
        ax.text(length, 1.0, " training length", transform=at, color=GREY, va="top", fontsize=8)
    ax.set_title(title, loc="left", fontsize=10)
    ax.set_xlabel(f"horizon ({unit})")
    ax.set_ylabel(ERROR)
    tidy(ax)


def legend_below(figure: Any, ax: "Axes", ncols: int, *, others: Sequence["Axes"] = ()) -> None:
    """One legend for all panels, under them: the lines of `ax`, and what `others` have more."""
    named: dict[str, Any] = {}
    for some in (ax, *others):
        for handle, label in zip(*some.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    figure.legend(
        named.values(),
        named.keys(),
        loc="outside lower center",
        ncols=ncols,
        frameon=False,
        handlelength=3.2,
    )


def share_y(axes: Any) -> None:
    """The same limits of the error in panels that are compared."""
    limits = np.array([ax.get_ylim() for ax in axes])
    for ax in axes:
        ax.set_ylim(limits[:, 0].min(), limits[:, 1].max())
