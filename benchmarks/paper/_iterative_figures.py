"""The best return so far by trial, as the paper draws it."""

from typing import TYPE_CHECKING, Any

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import legend_below
from benchmarks.paper._iterative_methods import BO, DISTILLED, METHODS, RANDOM
from benchmarks.paper._iterative_tables import INNER, NEAR, OUTER, Result, result, spread
from trajlearn.plotting._style import GREY, INK, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Panels: the column that is drawn and what it is.
PANELS = {
    "best_true": "mean over the common test starts",
    "best_seen": "as seen in the trials",
}
_SHADED = [BO, DISTILLED]
_MARKERS = "oDs^vP*XH+"


def draw(tables: Tables) -> "dict[str, Figure]":
    """One figure a task."""
    import matplotlib.pyplot as plt

    of = result(tables)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained", sharey=True)
    for ax, (column, what), letter in zip(axes, PANELS.items(), "ab", strict=True):
        for i, method in enumerate(METHODS):
            if method in of.methods:
                _curve(ax, of, method, column, i)
        ax.axhline(1.0, color=INK, lw=0.8)
        ax.axhline(NEAR, color=GREY, lw=1, ls="dotted")
        ax.set_title(f"{letter}  {of.task}: {what}", loc="left", fontsize=10)
        ax.set_xlabel("trial")
        ax.set_xticks(sorted(of.trials["trial"].unique()))
        tidy(ax)
    at = axes[1].get_yaxis_transform()
    for y, va, text, colour in (
        (1.0, "bottom", "best known", INK),
        (NEAR, "top", "within 5 %", GREY),
    ):
        axes[1].text(1.01, y, text, color=colour, va=va, fontsize=8, transform=at)
    axes[0].set_ylabel("best return so far (1: best known)")
    axes[0].set_ylim(_lowest(of), 1.03)
    legend_below(figure, axes[0], 3)
    return {of.task: figure}


def _curve(ax: "Axes", of: Result, method: str, column: str, i: int) -> None:
    """Median by trial; of two methods the ranges of most repeats as well."""
    values = of.by_trial(method, column)
    style: dict[str, Any] = line_style(i)
    if method == RANDOM:
        style = {"color": GREY, "linestyle": "solid"}
    shaded = method in _SHADED
    for share, alpha in ((OUTER, 0.10), (INNER, 0.18)) if shaded else ():
        low, high = spread(values, share)
        ax.fill_between(low.index, low, high, color=style["color"], alpha=alpha, lw=0)
    marks = {"marker": _MARKERS[i], "ms": 5, "mew": 1, "mfc": "white"}
    label = f"{method} (66 %, 95 % shaded)" if shaded else method
    width = 2.2 if shaded else 1.3
    ax.plot(values.columns, values.median(), lw=width, label=label, **marks, **style)


def _lowest(of: Result) -> float:
    """Where the axis begins: below every median; percentiles may go on under it."""
    medians = [
        of.by_trial(method, column).median().min() for column in PANELS for method in of.methods
    ]
    return min(medians) - 0.1
