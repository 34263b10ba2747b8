"""Models of networks' weights as people read them: text and figures from the tables alone."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._figures import ERROR
from benchmarks.paper._network_models import EVERY, INPUT_SCALE, MODELS, N_STARTS, WIDTHS, WINDOWS
from trajlearn.plotting._style import GREY, line_style, tidy

_MARKERS = "os^D"


def report(tables: Tables) -> str:
    """What models know of networks they have not seen, and what a search on them finds."""
    scores, errors = tables["scores"], tables["errors"]
    lines = ["### Held-out networks, and what CMA-ES finds", "", markdown(_summary(scores)), ""]
    lines += [*_explained(scores), "", "### Error by horizon", "", markdown(_windows(errors)), ""]
    lines += [
        "Median squared error of held-out episodes that reach the window, up to their end (range "
        "of the training states = 1); median over seeds (least to greatest). At the longest "
        "horizons only networks that stand are left.",
        "",
        *_verdict(scores),
    ]
    return "\n".join(lines)


def _spread(values: pd.Series, how: str = ".2f") -> str:
    some = values.dropna()
    if not len(some):
        return ""
    return f"{some.median():{how}} ({some.min():{how}} to {some.max():{how}})"


def _name(model: str) -> str:
    return {"constant": "best logged network", "simulator": "simulator itself"}.get(model, model)


def _summary(scores: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (n, model), some in scores.groupby(["n", "model"], sort=False):
        lines.append(
            {
                "episodes": n,
                "model": "constant; best logged network"
                if model == "constant"
                else _name(str(model)),
                "squared error": _spread(some["mse"], ".2g"),
                "rank correlation": _spread(some["rank"]),
                "found: true": _spread(some["found"]),
                "found: predicted": _spread(some["promised"]),
                "s to fit": _seconds(some["fit_s"]) if model != "simulator" else "",
                "s to search": _seconds(some["search_s"]),
            }
        )
    return pd.DataFrame(lines)


def _seconds(values: pd.Series) -> str:
    return "" if values.isna().all() else f"{values.median():.2g}"


def _explained(scores: pd.DataFrame) -> list[str]:
    told, plain = (
        " and ".join(f"{100 * share:.1f} % of {n}" for n, share in column.items())
        for column in (scores.groupby("n")[name].median() for name in ("stood", "stood_unscaled"))
    )
    return [
        "Median over seeds (least to greatest), returns per step. Squared error and rank "
        f"correlation: of held-out networks, mean return over {N_STARTS['assess']} starts. Found: "
        "what the search takes to be best, as predicted and in the simulator over "
        f"{N_STARTS['proposal']} starts. All searches begin with the same best logged networks "
        f"and have the same number of evaluations, over {N_STARTS['search']} starts. T gives the "
        f"reward of every {EVERY}th step. The best logged network is the one of the greatest "
        "logged return, from its one start (shown as predicted).",
        "",
        f"Weights are drawn from U[-1, 1] times a scale: {WIDTHS['input']:g} over "
        f"{', '.join(format(s, 'g') for s in INPUT_SCALE)} (position, speed, angle, rate) into "
        f"the hidden layer, {WIDTHS['output']:g} out of it, {WIDTHS['bias']:g} for biases. With "
        f"these {told} logged episodes stand for the whole trial; with U[-1, 1] as it is, {plain}.",
    ]


def _windows(errors: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (n, model), some in errors.groupby(["n", "model"], sort=False):
        line: dict[str, Any] = {"episodes": n, "model": model}
        for window in WINDOWS:
            at = some[some["window"] == window]
            line[f"steps {window}"] = _spread(at["median"], ".1g")
        lines.append(line)
    return pd.DataFrame(lines)


def _verdict(scores: pd.DataFrame) -> list[str]:
    """Who ranks best and who finds most, in the median over seeds."""
    text = []
    real = scores[~scores["model"].isin(["constant", "simulator"])]
    for n, some in real.groupby("n"):
        rank = some.groupby("model")["rank"].median()
        found = some.groupby("model")["found"].median()
        logged = scores[(scores["n"] == n) & (scores["model"] == "constant")]["found"].median()
        better = ", ".join(found[found > logged].sort_values(ascending=False).index) or "none"
        without = rank.drop("D, policy", errors="ignore")
        text.append(
            f"- {n} episodes: {rank.idxmax()} ranks best ({rank.max():.2f}), of those that do not "
            f"roll the network out {without.idxmax()} ({without.max():.2f}). Better networks than "
            f"the best logged one ({logged:.2f}) are found on: {better}."
        )
    return [
        *text,
        "",
        "Why: any permutation of the hidden units gives the same controller, so a model over "
        "weights sees a few hundred points in 31 dimensions, most of which say the same thing "
        "differently. Responses leave 8 numbers, but need the network as code, as a roll-out "
        "does. A one-step model needs no description at all: it has learnt the plant, which all "
        "episodes share, and is given the network. Where the controller can be called and the "
        "state is measured (without noise here), this is the way. Long horizons are learnt from "
        "the few networks that stand: a model that has hardly seen what becomes of bad networks "
        "so late may promise much of one, and a search finds it.",
    ]


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
    axes[0].set_yticks(range(len(models)), [_name(model) for model in models])
    axes[0].invert_yaxis()
    axes[0].set_xlabel("rank correlation, held-out networks")
    axes[0].set_xlim(-0.3, 1.05)
    axes[1].set_xlabel("reward per step of what is found")
    axes[1].set_xlim(0, 1.05)
    for ax in axes:
        ax.grid(axis="y", color=GREY, alpha=0.2)
        tidy(ax)
    named = [ax.get_legend_handles_labels() for ax in axes]
    figure.legend(
        named[0][0] + named[1][0],
        named[0][1] + named[1][1],
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
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
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        handlelength=3.2,
    )
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
