"""Figures of planning, from its tables alone."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import draw_curve, horizon_axes, legend_below, over_seeds
from benchmarks.paper._planning_refit import LABELS
from benchmarks.paper._planning_trials import ordered
from trajlearn.plotting._style import GREY, INK, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw(tables: Tables) -> dict[str, Any]:
    """Reward beside time; predicted against true; what data are worth."""
    return {
        "planning": _draw_trials(tables["trials"]),
        "planning-choices": _draw_choices(tables["choices"]),
        "planning-refit": _draw_refits(tables),
    }


def _draw_trials(flown: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    names = ordered(flown["planner"])
    figure, (left, right) = plt.subplots(
        1,
        2,
        figsize=(10, 0.34 * len(names) + 1.4),
        sharey=True,
        layout="constrained",
        width_ratios=(3, 2),
    )
    for i, name in enumerate(names):
        some = flown[flown["planner"] == name]
        shift = np.linspace(-0.22, 0.22, len(some)) if len(some) > 1 else np.zeros(len(some))
        left.plot(some["return"], i + shift, "|", color=GREY, ms=5, alpha=0.6)
        mean, std = some["return"].mean(), some["return"].std()
        left.errorbar(mean, i, xerr=std, fmt="o", color=INK, mfc="white", ms=6, capsize=3, lw=1.3)
        if some["decision_s"].notna().any():
            decision = 1000 * some["decision_s"].median()
            right.plot(decision, i, "o", color=line_style(0)["color"], ms=6)
            right.plot(
                1000 * some["trial_s"].median(),
                i,
                "D",
                color=line_style(1)["color"],
                ms=6,
                mfc="white",
            )
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    left.set_xlim(0, 1.05)
    left.set_xlabel("reward per step (mean ± std; a dash is a trial)")
    right.set_xscale("log")
    right.set_xlabel("planning time (ms, one core)")
    for marker, colour, face, label in (("o", 0, None, "a decision"), ("D", 1, "white", "a trial")):
        right.plot([], [], marker, color=line_style(colour)["color"], mfc=face, label=label)
    right.legend(frameon=False, loc="upper left", bbox_to_anchor=(0, 0.22))
    for ax in (left, right):
        ax.grid(axis="y", color=GREY, alpha=0.2)
        tidy(ax)
    return figure


def _draw_choices(faced: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), sharey=True, layout="constrained")
    for ax, (model, some) in zip(axes, faced.groupby("model", sort=False)):
        for i, (step, at) in enumerate(some.groupby("step")):
            style = line_style(i)
            ax.plot(
                at["predicted"],
                at["true"],
                "os^D"[i % 4],
                color=style["color"],
                ms=5,
                mfc="white",
                label=f"from step {step}",
            )
        ax.plot([0, 1], [0, 1], color=GREY, lw=1)
        ax.set(xlim=(0.5, 1.02), ylim=(0, 1.05))
        ax.set_xlabel("predicted reward per step of the favourite")
        ax.set_title(f"chosen by {model}", loc="left", fontsize=10)
        tidy(ax)
    axes[0].set_ylabel("true reward per step")
    axes[0].legend(frameon=False, loc="upper left")
    return figure


def _draw_refits(tables: Tables) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    errors = tables["errors"]
    present = [hold for hold in LABELS if hold in set(errors["hold"])]
    for i, hold in enumerate(present):
        rows = tables["rows"][tables["rows"]["hold"] == hold]
        counts = rows.groupby("horizon")["rows"].mean()
        if hold != "nothing":
            axes[0].plot(
                counts.index,
                counts.clip(lower=0.5),
                marker="os^Dv"[i % 5],
                ms=4,
                mfc="white",
                **line_style(i),
            )
        curve = over_seeds(errors[errors["hold"] == hold], ["horizon"])
        draw_curve(axes[1], curve, i, hold, band=("low", "high"))
        _strip(axes[2], tables["refits"], hold, i)
    axes[0].set(xscale="log", yscale="log", ylim=(0.4, None))
    axes[0].set_xlabel("horizon (steps)")
    axes[0].set_ylabel("rows under constant theta (none: at the bottom)")
    axes[0].set_title("what the added trials hold", loc="left", fontsize=10)
    horizon_axes(axes[1], title="error of new episodes")
    axes[2].set_xticks(
        range(len(present)),
        [name.replace(", ", ",\n").replace(" gains", "\ngains") for name in present],
        fontsize=7,
    )
    axes[2].set_ylim(0, 1.05)
    axes[2].set_ylabel("reward per step")
    axes[2].set_title("next trials", loc="left", fontsize=10)
    for ax in (axes[0], axes[2]):
        tidy(ax)
    legend_below(figure, axes[1], ncols=5)
    return figure


def _strip(ax: "Axes", trials: pd.DataFrame, hold: str, i: int) -> None:
    """Returns of the next trials after some data were added, and their mean."""
    some = trials[(trials["hold"] == hold) & (trials["when"] == "next")]["return"]
    colour = line_style(i)["color"]
    ax.plot(i + np.linspace(-0.2, 0.2, len(some)), some, "_", color=colour, ms=5)
    ax.plot(i, some.mean(), "o", color=INK, mfc="white", ms=6)
