"""Figures of the study of real flights, from its tables alone."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import draw_curve, legend_below, over_seeds
from benchmarks.paper._flights_models import LOGGED
from benchmarks.paper._flights_tables import ALL, MAIN, SKILL_AT, STATES
from trajlearn.plotting._style import GREY, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TITLES = {"experiment": "split by experiment", "block": "split by blocks in time"}
# rows of the curves, in the order of their styles
_CURVES = (
    "mean flight",
    "kernel ridge",
    "T, tracking error",
    "T, tracking error, no gains",
    "T, state",
    "C",
    "average",
    "D, logged actions, previous",
)
_SCATTER = ("T, tracking error", "direct GP")
# errors beyond are off the axis
_HIGHEST_MM = 1000.0


def draw(tables: Tables) -> dict[str, Any]:
    """Errors by horizon, skill by state, ranking, and one flight."""
    return {
        "real-flights-horizon": _horizon(tables["errors"], tables["floor"]),
        "real-flights-skill": _skill(tables["skill"]),
        "real-flights-ranking": _ranking(tables["scores"]),
        "real-flights-example": _example(tables["example"]),
    }


def _splits(table: pd.DataFrame) -> list[str]:
    return [split for split in _TITLES if (table["split"] == split).any()]


def _horizon(errors: pd.DataFrame, floor: pd.DataFrame) -> Any:
    """Driven axis of the main group and median nMSE of all, later starts."""
    import matplotlib.pyplot as plt

    splits = _splits(errors)
    figure, grid = plt.subplots(
        2, len(splits), figsize=(4.9 * len(splits), 7.4), layout="constrained", squeeze=False
    )
    own = floor[(floor["group"] == MAIN) & (floor["state"] == "y")]["repeats"]
    later = errors[errors["start"] == "later"]
    for axes, split in zip(grid.T, splits, strict=True):
        some = later[later["split"] == split]
        for ax, column, group, label in (
            (axes[0], "driven_mm", MAIN, "RMS error along y (mm)"),
            (axes[1], "nmse_median", ALL, "squared error (training range = 1)"),
        ):
            _curves(ax, some[some["group"] == group], column)
            what = MAIN if group == MAIN else "median of all flights, 12 states"
            ax.set_title(f"{what}\n{_TITLES[split]}", loc="left", fontsize=10)
            ax.set_ylabel(label)
        axes[0].set_ylim(top=min(_HIGHEST_MM, axes[0].get_ylim()[1]))
        axes[1].set_ylim(top=min(1.0, axes[1].get_ylim()[1]))
        if (own > 1e-6).any():
            axes[0].axhline(1e3 * own.iloc[0], color=GREY, lw=1, ls="dotted")
            place = axes[0].get_yaxis_transform()
            axes[0].text(
                0.02, 0.95e3 * own.iloc[0], "between repeats", transform=place, ha="left",
                va="top", color=GREY, fontsize=8,
            )  # fmt: skip
    legend_below(figure, grid[0, 0], ncols=3)
    return figure


def _curves(ax: "Axes", errors: pd.DataFrame, column: str) -> None:
    for i, row in enumerate(_CURVES):
        curve = over_seeds(errors[errors["row"] == row], ["horizon"], column)
        if len(curve):
            draw_curve(ax, curve, i, row, band=("low", "high"))
            ax.lines[-1].set_markevery(1)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("horizon (steps of 20 ms)")
    tidy(ax)


def _skill(skill: pd.DataFrame) -> Any:
    """A row a model, a column a state: skill against the mean flight in the main group."""
    import matplotlib.pyplot as plt

    main = skill[(skill["group"] == MAIN) & (skill["split"] == _splits(skill)[0])]
    rows = [row for row in main["row"].unique() if row not in ("hold", *LOGGED)]
    shown = [h for h in SKILL_AT if h > 1]
    figure, axes = plt.subplots(
        1, len(shown), figsize=(14.5, 0.42 * len(rows) + 1.3), layout="constrained", sharey=True
    )
    for ax, h in zip(np.atleast_1d(axes), shown, strict=True):
        at = main[main["horizon"] == h].pivot(index="row", columns="state", values="skill")
        values = at.loc[rows, list(STATES)].to_numpy()
        ax.imshow(np.clip(values, -1, 1), cmap="cividis", vmin=-1, vmax=1, aspect="auto")
        for i, j in np.ndindex(values.shape):
            light = values[i, j] < 0.2
            text = f"{values[i, j]:.1f}" if values[i, j] > -9.95 else "< -9"
            text = "0.0" if text == "-0.0" else text
            ax.text(j, i, text, ha="center", va="center", fontsize=7,
                    color="white" if light else "black")  # fmt: skip
        ax.set_xticks(range(len(STATES)), STATES, fontsize=8, rotation=45)
        ax.set_yticks(range(len(rows)), rows, fontsize=9)
        ax.set_title(f"h = {h}", loc="left", fontsize=10)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    split = _TITLES[_splits(skill)[0]]
    figure.suptitle(
        f"Skill against the mean flight (1 perfect, 0 no better), {MAIN}, {split}",
        x=0.01, ha="left", fontsize=11,
    )  # fmt: skip
    return figure


def _ranking(scores: pd.DataFrame) -> Any:
    """Predicted against flown tracking error of held-out flights of the main group."""
    import matplotlib.pyplot as plt

    main = scores[scores["group"] == MAIN].dropna()
    splits = _splits(main)
    figure, grid = plt.subplots(
        len(splits), len(_SCATTER), figsize=(8.2, 4.0 * len(splits)), layout="constrained",
        squeeze=False, sharex=True, sharey=True,
    )  # fmt: skip
    # wide enough for what was flown; what was predicted beyond is drawn at the edge
    low, high = 0.8e3 * main["flown"].min(), 1.25e3 * main["flown"].max()
    main = main.assign(predicted=main["predicted"].clip(1e-3 * low, 1e-3 * high))
    limits = [low, high]
    for axes, split in zip(grid, splits, strict=True):
        for ax, row in zip(axes, _SCATTER, strict=True):
            some = main[(main["split"] == split) & (main["row"] == row)]
            for fold, own in some.groupby("fold"):
                mark = {"marker": "os^Dv"[int(fold) % 5], "s": 22, "facecolor": "white"}
                color = line_style(int(fold))["color"]
                ax.scatter(
                    1e3 * own["predicted"], 1e3 * own["flown"], edgecolor=color, lw=1,
                    label=f"fold {int(fold) + 1}", **mark,
                )  # fmt: skip
            ax.plot(limits, limits, color=GREY, lw=1, zorder=0)
            ax.set(xscale="log", yscale="log", xlim=limits, ylim=limits)
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_formatter("{x:g}")
                if high < 10 * low:
                    axis.set_minor_formatter("{x:g}")
                axis.set_tick_params(which="both", labelsize=7)
            ax.set_title(f"{row}, {_TITLES[split]}", loc="left", fontsize=10)
            ax.set_xlabel("predicted tracking error (mm)")
            ax.set_ylabel("flown tracking error (mm)")
            tidy(ax)
    legend_below(figure, grid[0, 0], ncols=5)
    return figure


def _example(example: pd.DataFrame) -> Any:
    """One held-out flight and its forecasts from the beginning of the motion."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13.5, 3.9), layout="constrained")
    target = example[example["row"] == "set-point"]["y"].to_numpy()
    looks = {"flown": {"color": "black", "lw": 2.2}, "set-point": {"color": GREY, "lw": 1}}
    for i, (row, some) in enumerate(example.groupby("row", sort=False)):
        look = looks.get(str(row)) or {"lw": 1.4, **line_style(i)}
        phase = some["phase"]
        axes[0].plot(phase, some["y"], label=row, **look)
        if row != "set-point":
            axes[1].plot(phase, 1e3 * (some["y"].to_numpy() - target), **look)
            axes[2].plot(phase, np.degrees(some["roll"]), **look)
    flight = example["flight"].iloc[0]
    for ax, title in zip(axes, ("y (m)", "y minus set-point (mm)", "roll (degrees)"), strict=True):
        ax.set_title(f"{flight}: {title}", loc="left", fontsize=10)
        ax.set_ylabel(title)
        ax.set_xlabel("time since the motion began (s)")
        tidy(ax)
    legend_below(figure, axes[0], ncols=5)
    return figure
