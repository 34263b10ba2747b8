"""How the error grows with the horizon."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from trajlearn.evaluation import summarise
from trajlearn.plotting._style import GREY, axes_or_new, line_style, tidy

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["plot_horizon_errors"]


# squared error at which a forecast counts as diverged: 1e6 training ranges
_DIVERGED = 1e12


def plot_horizon_errors(
    tables: "Mapping[str, pd.DataFrame]",
    ax: "Axes | None" = None,
    *,
    band: tuple[str, ...] = ("q65", "q95"),
    training_length: float | None = None,
    ceiling: float = 100.0,
) -> "Axes":
    """Median error by horizon, with shading up to higher percentiles.

    Parameters
    ----------
    tables : mapping from label to DataFrame
        As from `horizon_errors`, `summarise` or `cross_validate_horizons` (averaged over folds).
    ax : matplotlib Axes, optional
        Default: a new figure.
    band : tuple of str, default=("q65", "q95")
        Columns up to which the space above the median is shaded; () for none.
    training_length : float, optional
        Longest horizon in training, in steps: a vertical line, beyond which a model extrapolates.
    ceiling : float, default=100.0
        Greatest squared error shown; a diverged forecast lies above any.

    Returns
    -------
    matplotlib Axes
        Logarithmic in the error. A triangle at the top says where a median passes `ceiling`;
        the legend counts the episodes whose forecasts diverge.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is nothing to plot, or a table is of none of these kinds.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> errors = pd.DataFrame([[0.01, 0.02, 0.03], [0.01, 0.03, np.inf]], columns=[1, 2, 3])
    >>> ax = plot_horizon_errors({"D": errors}, training_length=2)
    >>> ax.get_yscale(), ax.get_lines()[0].get_label()
    ('log', 'D (1 of 2 diverge)')
    """
    if not tables:
        raise ValueError("tables is empty: give a mapping from label to table.")
    summaries = {label: _summary(label, table) for label, table in tables.items()}
    ax = axes_or_new(ax, "plot_horizon_errors", (6.4, 3.6 + 0.2 * len(tables)))
    ax.set_yscale("log", nonpositive="mask")
    greatest = 0.0
    for i, (label, summary) in enumerate(summaries.items()):
        style = line_style(i)
        horizon = summary.index.to_numpy(dtype=np.float64)
        shown = summary[["median", *band]].to_numpy(dtype=np.float64).clip(max=_DIVERGED)
        greatest = max(greatest, np.nanmax(shown, initial=0.0))
        median = shown[:, 0]
        marker = "o" if len(horizon) == 1 else None
        ax.plot(horizon, median, label=_label(label, summary), lw=2, marker=marker, **style)
        for upper in shown[:, 1:].T:
            ax.fill_between(horizon, median, upper, color=style["color"], alpha=0.13, linewidth=0)
        off = np.flatnonzero(median > ceiling)
        if len(off):
            look: dict[str, Any] = {"marker": "^", "ms": 8, "color": style["color"]}
            at_top = ax.get_xaxis_transform()
            ax.plot(horizon[off[0]], 1.0, transform=at_top, clip_on=False, zorder=5, **look)
    if greatest > ceiling:
        ax.set_ylim(top=ceiling)
    if training_length is not None:
        ax.axvline(
            training_length, color=GREY, lw=1, ls="dotted", label="longest horizon in training"
        )
    ax.set_xlabel("horizon (steps)")
    ax.set_ylabel("squared error (training range = 1)")
    columns = 1 if max(map(len, summaries)) > 16 else 2
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, frameon=False, handlelength=3)
    tidy(ax)
    return ax


def _summary(label: str, table: "pd.DataFrame") -> "pd.DataFrame":
    if {"horizon", "fold", "median"} <= set(table.columns):
        by_horizon = table.drop(columns="fold").groupby("horizon")
        counts = by_horizon[["n_episodes", "n_diverged"]].sum()
        return by_horizon[["median", "mean", "q65", "q95"]].mean().join(counts)
    if "median" in table.columns:
        return table
    if len(table.columns) and np.issubdtype(np.asarray(table.columns).dtype, np.number):
        return summarise(table)
    raise ValueError(
        f"tables[{label!r}] has the columns {list(table.columns)}: give a table from "
        "horizon_errors, summarise or cross_validate_horizons."
    )


def _label(label: str, summary: "pd.DataFrame") -> str:
    n_diverged = int(summary["n_diverged"].max())
    if not n_diverged:
        return label
    return f"{label} ({n_diverged} of {int(summary['n_episodes'].max())} diverge)"
