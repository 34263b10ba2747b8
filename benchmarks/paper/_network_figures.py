"""Figures of models of networks' weights, from the tables alone."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._figures import ERROR, legend_below
from benchmarks.paper._network_models import MODELS, WINDOWS, shown
from trajlearn.plotting._style import GREY, line_style, tidy

_MARKERS = "os^D"


def draw(tables: Tables) -> dict[str, Any]:
    """Scores and finds of all models; errors by horizon; predicted against true returns."""
    return {
        "network-policy": _draw_scores(tables["scores"]),
        "network-policy-errors": _draw_errors(tables["errors"]),
        "network-policy-returns": _draw_returns(tables["returns"]),
    }


def _draw_scores(scores: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    models = [model for model in MODELS if model in set(scores["model"])]
    sizes = sorted(set(scores["n"]))
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.6), sharey=True, layout="constrained")
    for k, n in enumerate(sizes):
        style = {"color": line_style(k)["color"], "marker": _MARKERS[k], "ls": "none", "ms": 6}
        for i, model in enumerate(models):
            some = scores[(scores["n"] == n) & (scores["model"] == model)]
            y = i + (k - (len(sizes) - 1) / 2) * 0.3
            for ax, column in zip(axes, ("rank", "found")):
                values = some[column].dropna()
                if len(values):
                    ax.plot([values.min(), values.max()], [y, y], color=style["color"], lw=1.2)
                    ax.plot(values.median(), y, **style)
            axes[1].plot(some["promised"].median(), y, **style, mfc="white")
        axes[0].plot([], [], **style, label=f"{n} episodes (line: over seeds)")
    axes[1].plot([], [], "o", color=GREY, mfc="white", label="as predicted")
    axes[0].set_yticks(range(len(models)), [shown(model) for model in models])
    axes[0].invert_yaxis()
    axes[0].set_xlabel("rank correlation, held-out networks")
    axes[0].set_xlim(-0.3, 1.05)
    axes[1].set_xlabel("reward per step of what is found")
    axes[1].set_xlim(0, 1.05)
    for ax in axes:
        ax.grid(axis="y", color=GREY, alpha=0.2)
        tidy(ax)
    legend_below(figure, axes[0], ncols=3, others=axes[1:])
    return figure


def _draw_errors(errors: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    sizes = sorted(set(errors["n"]))
    figure, axes = plt.subplots(
        1,
        len(sizes),
        figsize=(4.4 * len(sizes), 3.4),
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    at = np.arange(len(WINDOWS))
    for ax, n in zip(axes[0], sizes):
        for i, (model, some) in enumerate(errors[errors["n"] == n].groupby("model", sort=False)):
            by = some.groupby("window")["median"]
            middle, low, high = (
                f.reindex(list(WINDOWS)) for f in (by.median(), by.min(), by.max())
            )
            style = line_style(i)
            ax.plot(at, middle, marker=_MARKERS[i], ms=5, mfc="white", label=model, **style)
            ax.fill_between(at, low, high, color=style["color"], alpha=0.13, lw=0)
        ax.set_yscale("log")
        ax.set_xticks(at, list(WINDOWS))
        ax.set_xlabel("horizon (steps)")
        ax.set_title(f"{n} episodes", loc="left", fontsize=10)
        tidy(ax)
    axes[0, 0].set_ylabel(ERROR)
    legend_below(figure, axes[0, 0], ncols=3)
    return figure


def _draw_returns(returns: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    models = [m for m in MODELS if m in set(returns["model"]) and m != "constant"]
    sizes = sorted(set(returns["n"]))
    figure, grid = plt.subplots(
        len(sizes),
        len(models),
        figsize=(2.1 * len(models), 2.3 * len(sizes)),
        sharex=True,
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for axes, n in zip(grid, sizes):
        for ax, model in zip(axes, models):
            some = returns[(returns["n"] == n) & (returns["model"] == model)]
            ax.plot([0, 1], [0, 1], color=GREY, lw=1)
            ax.plot(some["true"], some["predicted"], ".", color=line_style(0)["color"], ms=4)
            ax.set_title(f"{model}, {n}", loc="left", fontsize=9)
            tidy(ax)
        axes[0].set_ylabel("predicted")
    for ax in grid[-1]:
        ax.set_xlabel("true reward per step", fontsize=9)
    return figure
