"""How well rewards are predicted."""

from typing import TYPE_CHECKING, Any

import numpy as np

from trajlearn.plotting._style import GREY, INK, axes_or_new, line_style, tidy

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["plot_reward_table"]


def plot_reward_table(
    table: "pd.DataFrame", ax: "Axes | None" = None, *, ceiling: float = 100.0
) -> "Axes":
    """Squared reward error of several methods, one bar a method.

    Parameters
    ----------
    table : DataFrame
        Index: the methods, drawn from top to bottom. Columns ``mean`` and ``median`` of the
        squared error; optionally ``paper`` (a published mean, NaN where there is none),
        ``n_diverged`` and ``n_episodes``. Rows as from `reward_errors`.
    ax : matplotlib Axes, optional
        Default: a new figure.
    ceiling : float, default=100.0
        Greatest error shown, so that a method that diverges does not squeeze the others.

    Returns
    -------
    matplotlib Axes
        The bar ends at the mean, on a logarithmic axis; a thick line marks the median, a diamond
        the published figure. A mean above `ceiling`, or infinite, is a hatched bar across the
        axes, a median there a triangle at the edge. Beside each bar stands the mean or, where
        it is infinite, how many forecasts diverged.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If the table is empty, lacks a column, or has no positive finite number.

    Examples
    --------
    >>> import pandas as pd
    >>> from trajlearn.evaluation import reward_errors
    >>> rows = {
    ...     "T": reward_errors([0.9, 2.1, 3.0], [1.0, 2.0, 3.2]),
    ...     "constant": reward_errors([2.0, 2.0, 2.0], [1.0, 2.0, 3.2]),
    ... }
    >>> ax = plot_reward_table(pd.DataFrame.from_dict(rows, orient="index"))
    >>> [label.get_text() for label in ax.get_yticklabels()]
    ['T', 'constant']
    """
    missing = {"mean", "median"} - set(table.columns)
    if missing or table.empty:
        raise ValueError(
            f"table has {len(table)} rows and the columns {list(table.columns)}: give at least "
            "mean and median, a row a method."
        )
    numbers = table.reindex(columns=["mean", "median", "paper"]).to_numpy(dtype=np.float64)
    shown = numbers[np.isfinite(numbers) & (numbers > 0)]
    if not len(shown):
        raise ValueError("table has no positive finite error to draw on a logarithmic axis.")
    right = min(shown.max() * 2, ceiling)
    left = min(shown.min(), right) / 2
    mean, median, paper = numbers.T
    y, beyond = np.arange(len(table)), mean > right
    bars = np.clip(mean, left, right) - left
    ax = axes_or_new(ax, "plot_reward_table", (6.4, 1.1 + 0.36 * len(table)))
    ax.set_xscale("log")
    shape: dict[str, Any] = {"left": left, "height": 0.6}
    fill = line_style(0)["color"]
    ax.barh(y[~beyond], bars[~beyond], color=fill, alpha=0.35, label="mean", **shape)
    if beyond.any():
        shape |= {"facecolor": "white", "edgecolor": GREY, "hatch": "///"}
        ax.barh(y[beyond], bars[beyond], label="mean off the axis", **shape)
    dash: dict[str, Any] = {"marker": "|", "s": 180, "lw": 2.5, "color": INK}
    ax.scatter(median, np.where(median <= right, y, np.nan), label="median", **dash)
    off = y[median > right]
    ax.scatter(np.full(len(off), right), off, marker=">", s=40, color=INK, clip_on=False, zorder=5)
    if np.isfinite(paper).any():
        ax.scatter(paper, y, marker="D", s=32, color="white", edgecolor=INK, label="mean, paper")
    for at, text in zip(y, _texts(table)):
        ax.annotate(
            text,
            (1.03, at),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize="small",
        )
    ax.set_xlim(left, right)
    ax.set_yticks(y, [str(name) for name in table.index])
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("squared error of the reward per step")
    ax.legend(
        loc="lower right",
        bbox_to_anchor=(1.05, 1),
        ncols=4,
        frameon=False,
        handlelength=1.4,
        handletextpad=0.5,
        columnspacing=1.2,
    )
    tidy(ax)
    return ax


def _texts(table: "pd.DataFrame") -> list[str]:
    """Mean of each row, or how many of its forecasts diverged."""
    texts = []
    for _, row in table.iterrows():
        text = f"{row['mean']:.2g}"
        if not np.isfinite(row["mean"]) and "n_diverged" in row:
            total = f" of {int(row['n_episodes'])}" if "n_episodes" in row else ""
            text = f"{int(row['n_diverged'])}{total} diverge"
        texts.append(text)
    return texts
