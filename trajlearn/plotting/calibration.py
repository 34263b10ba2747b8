"""Whether the uncertainty of forecasts can be trusted."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.plotting._style import GREY, line_style, pyplot, tidy

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["plot_coverage", "plot_pit", "plot_reliability"]

Floats = NDArray[np.float64]

_MOST_PANELS = 6
_MARKERS = "osD^vP"


def plot_coverage(
    reports: "pd.DataFrame | Mapping[str, pd.DataFrame]",
    axes: "Axes | Sequence[Axes] | None" = None,
    *,
    state: str = "all",
    levels: Sequence[float] | None = None,
) -> "NDArray[Any]":
    """Coverage of the intervals by horizon, a panel a level.

    Parameters
    ----------
    reports : DataFrame or mapping from label to DataFrame
        As from `calibration_report`, of bins or of every horizon (``bins=None``).
    axes : matplotlib Axes or sequence of Axes, optional
        One a level. Default: a new figure.
    state : str, default="all"
        The state whose coverage is drawn.
    levels : sequence of float, optional
        Default: all that every report has.

    Returns
    -------
    ndarray of matplotlib Axes of shape (n_levels,)
        Bars or shading are the bootstrap intervals; a dashed line marks the level that the
        intervals promise. Diverged forecasts cover nothing; the legend counts their episodes.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is nothing to draw, or the number of axes is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> from trajlearn.evaluation.calibration import calibration_report
    >>> ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(60, 31, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:40])
    >>> report = calibration_report(model.predict(ds[40:], return_std=True), ds[40:])
    >>> axes = plot_coverage({"T": report}, levels=[0.5, 0.9])
    >>> [ax.get_title() for ax in axes]
    ['50 % intervals', '90 % intervals']
    """
    tables = _of_state(reports, "coverage", state)
    if levels is None:
        shared = set.intersection(*(set(table["level"]) for table in tables.values()))
        levels = sorted(shared)
    tables = {
        label: table[np.isin(table["level"], list(levels))] for label, table in tables.items()
    }
    if not levels or any(set(table["level"]) != set(levels) for table in tables.values()):
        raise ValueError(f"levels = {list(levels)} are not in every report.")
    panels = _panels(axes, len(levels), "plot_coverage", "level")
    by_step = all((table["first"] == table["last"]).all() for table in tables.values())
    bins = _bins(tables)
    for ax, level in zip(panels, levels):
        ax.axhline(level, color=GREY, lw=1, ls=(0, (4, 3)), zorder=1, label="promised")
        for i, (label, table) in enumerate(tables.items()):
            rows = table[table["level"] == level]
            text = _counted(label, table)
            if by_step:
                _curve(ax, rows["first"].to_numpy(), rows, text, i)
            else:
                place = {b: j + 0.12 * (i - (len(tables) - 1) / 2) for j, b in enumerate(bins)}
                x = np.array([place[b] for b in zip(rows["first"], rows["last"])])
                _bars(ax, x, rows, text, i)
        if not by_step:
            ax.set_xticks(range(len(bins)), [_steps(b) for b in bins], rotation=35)
            ax.set_xlim(-0.5, len(bins) - 0.5)
        ax.set_title(f"{100 * level:g} % intervals", fontsize="medium")
        ax.set_xlabel("horizon (steps)")
        ax.set_ylim(top=1.02)
        tidy(ax)
    panels[0].set_ylabel("coverage" if state == "all" else f"coverage of {state}")
    _one_legend(panels, axes is None)
    return panels


def plot_reliability(
    tables: "pd.DataFrame | Mapping[str, pd.DataFrame]",
    axes: "Axes | Sequence[Axes] | None" = None,
    *,
    state: str = "all",
) -> "NDArray[Any]":
    """Reliability diagram: coverage against the level promised, a panel a horizon bin.

    Parameters
    ----------
    tables : DataFrame or mapping from label to DataFrame
        As from `reliability` (or `calibration_report`), with the same few bins.
    axes : matplotlib Axes or sequence of Axes, optional
        One a bin. Default: a new figure.
    state : str, default="all"
        The state that is drawn.

    Returns
    -------
    ndarray of matplotlib Axes of shape (n_bins,)
        A calibrated forecast follows the diagonal; below it the forecast is too sure of itself,
        above it not sure enough. Shading is the bootstrap interval.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is nothing to draw, there are more than 6 bins, or the number of axes is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> from trajlearn.evaluation.calibration import reliability
    >>> ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(60, 31, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:40])
    >>> table = reliability(model.predict(ds[40:], return_std=True), ds[40:])
    >>> [ax.get_title() for ax in plot_reliability({"T": table})]
    ['steps 1-5', 'steps 6-25', 'steps 26-30']
    """
    chosen = _of_state(tables, "coverage", state)
    bins = _bins(chosen)
    panels = _panels(axes, len(bins), "plot_reliability", "bin")
    for ax, steps in zip(panels, bins):
        ax.plot([0, 1], [0, 1], color=GREY, lw=1, ls=(0, (4, 3)), zorder=1, label="ideal")
        for i, (label, table) in enumerate(chosen.items()):
            rows = _of_bin(table, steps).sort_values("level")
            _curve(ax, rows["level"].to_numpy(), rows, _counted(label, table), i)
        ax.set(xlim=(0, 1), ylim=(0, 1.01), xlabel="level promised")
        ax.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        ax.set_title(f"steps {_steps(steps)}", fontsize="medium")
        tidy(ax)
    panels[0].set_ylabel("coverage" if state == "all" else f"coverage of {state}")
    _one_legend(panels, axes is None)
    return panels


def plot_pit(
    tables: "pd.DataFrame | Mapping[str, pd.DataFrame]",
    axes: "Axes | Sequence[Axes] | None" = None,
    *,
    state: str = "all",
) -> "NDArray[Any]":
    """Histogram of the probability integral transform, a panel a horizon bin.

    Parameters
    ----------
    tables : DataFrame or mapping from label to DataFrame
        As from `pit_histogram`, with the same few bins.
    axes : matplotlib Axes or sequence of Axes, optional
        One a bin. Default: a new figure.
    state : str, default="all"
        The state that is drawn.

    Returns
    -------
    ndarray of matplotlib Axes of shape (n_bins,)
        Flat at 1 if calibrated; high at both ends if too sure, in the middle if not sure enough,
        at one end if biased. Bars are the bootstrap intervals.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is nothing to draw, there are more than 6 bins, or the number of axes is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> from trajlearn.evaluation.calibration import pit_histogram
    >>> ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(60, 11, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:40])
    >>> table = pit_histogram(model.predict(ds[40:], return_std=True), ds[40:])
    >>> len(plot_pit(table))
    2
    """
    chosen = _of_state(tables, None, state)
    bins = _bins(chosen)
    panels = _panels(axes, len(bins), "plot_pit", "bin")
    for ax, steps in zip(panels, bins):
        ax.axhline(1.0, color=GREY, lw=1, ls=(0, (4, 3)), zorder=1, label="ideal")
        for i, (label, table) in enumerate(chosen.items()):
            rows = _of_bin(table, steps)
            edges = np.append(rows["left"], rows["right"].iloc[-1])
            look = line_style(i)
            height = rows["value"].to_numpy()
            ax.stairs(height, edges, lw=1.8, label=_counted(label, table), **look)
            if len(chosen) == 1:
                ax.stairs(height, edges, fill=True, color=look["color"], alpha=0.15)
            # side by side inside a bar
            share = (i + 1) / (len(chosen) + 1)
            x = edges[:-1] + share * np.diff(edges)
            ax.vlines(x, rows["low"], rows["high"], color=look["color"], lw=1)
        ax.set(xlim=(0, 1), xlabel="predicted probability\nbelow what was logged")
        ax.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        ax.set_title(f"steps {_steps(steps)}", fontsize="medium")
        tidy(ax)
    for ax in panels:
        ax.set_ylim(bottom=0)
    panels[0].set_ylabel("density" if state == "all" else f"density, {state}")
    _one_legend(panels, axes is None)
    return panels


# -- tables -------------------------------------------------------------------------------


def _of_state(tables: Any, measure: str | None, state: str) -> "dict[str, pd.DataFrame]":
    """Rows of one measure and state of each table."""
    if not isinstance(tables, Mapping):
        tables = {"forecast": tables}
    if not tables:
        raise ValueError("there is no table to draw: give one, or a mapping from label to table.")
    found = {}
    for label, table in tables.items():
        needed = {"left", "right"} if measure is None else {"measure", "level"}
        if not needed <= set(table.columns):
            source = "pit_histogram" if measure is None else "calibration_report or reliability"
            raise ValueError(f"table {label!r} has no {sorted(needed)}: give one from {source}.")
        rows = table[table["state"] == state]
        if measure is not None:
            rows = rows[rows["measure"] == measure]
        if not len(rows):
            raise ValueError(
                f"table {label!r} has no state {state!r}; choose from "
                f"{list(table['state'].unique())}."
            )
        found[label] = rows
    return found


def _bins(tables: "Mapping[str, pd.DataFrame]") -> list[tuple[int, int]]:
    return sorted({b for table in tables.values() for b in zip(table["first"], table["last"])})


def _of_bin(table: "pd.DataFrame", steps: tuple[int, int]) -> "pd.DataFrame":
    return table[(table["first"] == steps[0]) & (table["last"] == steps[1])]


def _steps(steps: tuple[int, int]) -> str:
    return f"{steps[0]}" if steps[0] == steps[1] else f"{steps[0]}-{steps[1]}"


def _counted(label: str, table: "pd.DataFrame") -> str:
    """Label with the number of episodes that diverge."""
    n_diverged = int(table["n_diverged"].max())
    if not n_diverged:
        return label
    return f"{label} ({n_diverged} of {int(table['n_episodes'].max())} diverge)"


# -- drawing ------------------------------------------------------------------------------


def _panels(axes: Any, n_panels: int, by: str, what: str) -> "NDArray[Any]":
    plt = pyplot(by)
    if n_panels > _MOST_PANELS:
        raise ValueError(
            f"{n_panels} panels, one a {what}, cannot be read: choose at most {_MOST_PANELS}."
        )
    if axes is None:
        size = (1.0 + 2.6 * n_panels if n_panels > 1 else 4.6, 3.4)
        _, axes = plt.subplots(
            1, n_panels, sharey=True, squeeze=False, figsize=size, layout="constrained"
        )
    panels = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(panels) != n_panels:
        raise ValueError(f"{len(panels)} axes for {n_panels} panels: give one a {what}.")
    return panels


def _curve(ax: "Axes", x: Floats, rows: "pd.DataFrame", label: str, i: int) -> None:
    """Line with a shaded bootstrap interval."""
    style = line_style(i)
    marker = _MARKERS[i % len(_MARKERS)] if len(x) < 25 else None
    look = style | {"lw": 1.8, "marker": marker, "ms": 4}
    ax.plot(x, rows["value"], label=label, **look)
    ax.fill_between(x, rows["low"], rows["high"], color=style["color"], alpha=0.18, lw=0)


def _bars(ax: "Axes", x: Floats, rows: "pd.DataFrame", label: str, i: int) -> None:
    """Markers with bootstrap intervals."""
    style = line_style(i)
    ax.vlines(x, rows["low"], rows["high"], color=style["color"], lw=1.4)
    look = style | {"lw": 0.8, "marker": _MARKERS[i % len(_MARKERS)], "ms": 6}
    ax.plot(x, rows["value"], label=label, **look)


def _one_legend(panels: "NDArray[Any]", own_figure: bool) -> None:
    """Above a figure of ours, else inside the first of the given axes."""
    handles, labels = panels[0].get_legend_handles_labels()
    if own_figure:
        panels[0].figure.legend(
            handles, labels, loc="outside upper center", ncols=4, frameon=False, handlelength=3
        )
    else:
        panels[0].legend(handles, labels, frameon=False, handlelength=3)
