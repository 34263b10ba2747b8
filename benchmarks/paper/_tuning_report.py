"""Text and figures of the tuning benchmark, from its table of scores by fold."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._figures import ERROR, legend_below
from benchmarks.paper._grids import TRAINED, shown
from trajlearn.plotting._style import GREY, INK, line_style, tidy

#: How sources of actions and origins of values are written.
ACTIONS = {"none": "", "policy": "recomputed", "logged": "logged"}
MARKS = {"final": " (paper)", "swept": "", "beyond": " (beyond)"}
WITHIN = "within the spread"
#: Panels in a row of a figure, at most.
COLUMNS = 4


def report(tables: Tables) -> str:
    """Whether the paper's values are the best of their sweeps, then all errors."""
    scores = tables["scores"]
    verdicts = _verdicts(scores)
    holds = verdicts["holds"].value_counts()
    lines = [
        f"{ERROR.capitalize()}, averaged over the training length and over the held-out episodes "
        "of a fold.",
        "",
        f"The paper's final value is the best of its own sweep in {holds.get('yes', 0)} of "
        f"{len(verdicts)} cases; in {holds.get(WITHIN, 0)} another",
        f"value is better on average but not on every fold of every seed; in {holds.get('no', 0)} "
        "one is better on all of them.",
        "Ratios are of one fold and seed: median (least to greatest).",
        "Training is shorter than the paper's final one (its steps are listed), which favours "
        "large rates and small",
        "batches; always Adam. The LSTM's width and depth are not swept. `rows` are the paper's "
        "caps, of which it trained",
        f"on {TRAINED:.0%}; with `same steps` more rows do not mean more steps.",
        "",
        markdown(verdicts),
        "",
        "A learning rate above any that the paper swept:",
        "",
        markdown(_higher_rates(scores)),
        "",
    ]
    lines += [
        "A choice by logged actions, assessed with recomputed ones. Logged actions do not answer "
        "to the errors of a",
        "roll-out: where the plant alone is unstable (cartpole), a model that knows it diverges, "
        "and one that has hardly",
        "learnt may seem better.",
        "",
        markdown(_chosen_by_logged(scores)),
        "",
    ]
    for (task, model), some in scores.groupby(["task", "model"], sort=False):
        lines += [f"### {model} on {task}", "", markdown(_errors(some)), ""]
    lines += [
        "Error: mean over seeds of the mean over folds (least to greatest seed; standard deviation "
        "over folds, mean over",
        "seeds). `median`: the same of the median over episodes. Seconds: of one fit.",
    ]
    return "\n".join(lines)


def _by_value(scores: pd.DataFrame, column: str = "mean") -> pd.DataFrame:
    """A line a seed and fold, a column a value of one parameter, in the order of the sweep."""
    table = scores.pivot(index=["seed", "fold"], columns="value", values=column)
    return table.sort_index(axis=1)


def _verdicts(scores: pd.DataFrame) -> pd.DataFrame:
    """The paper's final value against the best value of its sweep."""
    lines = []
    by = ["task", "model", "parameter", "actions"]
    for (task, model, parameter, actions), some in scores.groupby(by, sort=False):
        table = _by_value(some[some["origin"] != "beyond"])
        final = some.loc[some["origin"] == "final", "value"].iloc[0]
        best = table.mean().idxmin()
        better = table[best] < table[final]
        verdict = "yes" if best == final else "no" if better.all() else WITHIN
        lines.append(
            {
                "task": task,
                "model": model,
                "parameter": parameter,
                "actions": ACTIONS[actions],
                "paper's final": shown(final),
                "best swept": shown(best),
                "error of final / best": "" if best == final else _ratio(table[final], table[best]),
                "folds where better": "" if best == final else f"{better.sum()} of {len(better)}",
                "holds": verdict,
            }
        )
    return pd.DataFrame(lines)


def _higher_rates(scores: pd.DataFrame) -> pd.DataFrame:
    """The learning rate beyond each sweep against the final one and the best of the sweep."""
    lines = []
    rates = scores[scores["parameter"] == "learning rate"]
    for (task, model, actions), some in rates.groupby(["task", "model", "actions"], sort=False):
        table, origins = _by_value(some), some.groupby("value")["origin"].first()
        beyond, final = (origins.index[origins == name][0] for name in ("beyond", "final"))
        best = table.drop(columns=beyond).mean().idxmin()
        better = table[beyond] < table[best]
        lines.append(
            {
                "task": task,
                "model": model,
                "actions": ACTIONS[actions],
                "rate": shown(beyond),
                "error / that of the final rate": _ratio(table[beyond], table[final]),
                "best swept": shown(best),
                "error / that of the best swept": _ratio(table[beyond], table[best]),
                "folds where better": f"{better.sum()} of {len(better)}",
            }
        )
    return pd.DataFrame(lines)


def _chosen_by_logged(scores: pd.DataFrame) -> pd.DataFrame:
    """What the value that is best with logged actions is worth with recomputed ones."""
    lines = []
    both = scores[scores["actions"] != "none"]
    for (task, model, parameter), some in both.groupby(["task", "model", "parameter"], sort=False):
        by_source = {name: _by_value(of) for name, of in some.groupby("actions")}
        best = {name: table.mean().idxmin() for name, table in by_source.items()}
        table = by_source["policy"]
        lines.append(
            {
                "task": task,
                "model": model,
                "parameter": parameter,
                "best, logged": shown(best["logged"]),
                "best, recomputed": shown(best["policy"]),
                "recomputed error of the first / second": _ratio(
                    table[best["logged"]], table[best["policy"]]
                ),
            }
        )
    return pd.DataFrame(lines)


def _errors(scores: pd.DataFrame) -> pd.DataFrame:
    """Every value with its errors, by source of actions."""
    lines = []
    for parameter, of_parameter in scores.groupby("parameter", sort=False):
        for value, some in of_parameter.groupby("value"):
            mark = MARKS[some["origin"].iloc[0]]
            line = {"parameter": parameter, "value": shown(value) + mark}
            line["steps"] = f"{some['steps'].mean():.0f}"
            for actions, of_source in some.groupby("actions", sort=False):
                name = "error" if actions == "none" else f"error, {ACTIONS[actions]}"
                line[name] = _spread(of_source, "mean")
                line[name.replace("error", "median")] = f"{of_source['median'].mean():.2g}"
            line["seconds"] = some["fit_seconds"].mean()
            lines.append(line)
    return pd.DataFrame(lines)


def _spread(scores: pd.DataFrame, column: str) -> str:
    folds = scores.groupby("seed")[column]
    means = folds.mean()
    around = f"{means.min():.2g} to {means.max():.2g}"
    # infinite values have no standard deviation
    within = f"; {folds.std(ddof=0).mean():.1g}" if np.isfinite(means).all() else ""
    return f"{means.mean():.2g} ({around}{within})"


def _ratio(one: pd.Series, other: pd.Series) -> str:
    """Ratio by fold and seed: median (least to greatest)."""
    ratio = one / other
    return f"{ratio.median():.2g} ({ratio.min():.2g} to {ratio.max():.2g})"


def draw(tables: Tables) -> dict[str, Any]:
    """A figure a model, a panel a task, source of actions and parameter."""
    scores = tables["scores"]
    return {f"tuning-{name}": _figure(some) for name, some in scores.groupby("model", sort=False)}


def _figure(scores: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    rows = _rows([some for _, some in scores.groupby(["task", "actions"], sort=False)])
    n_columns = max(map(len, rows))
    figure, grid = plt.subplots(
        len(rows),
        n_columns,
        figsize=(2.5 * n_columns + 0.8, 2.6 * len(rows) + 0.5),
        layout="constrained",
        squeeze=False,
    )
    for axes, row in zip(grid, rows):
        for ax, some in zip(axes, row):
            _panel(ax, some)
        for ax in axes[len(row) :]:
            ax.set_visible(False)
        axes[0].set_ylabel("squared error\n(training range = 1)")
    legend_below(figure, grid[0, 0], ncols=4 if n_columns > 3 else 2)
    return figure


def _rows(groups: list[pd.DataFrame]) -> list[list[pd.DataFrame]]:
    """Panels of a group in rows of its own; small groups share one."""
    rows: list[list[pd.DataFrame]] = [[]]
    for group in groups:
        panels = [some for _, some in group.groupby("parameter", sort=False)]
        if len(rows[-1]) + len(panels) > COLUMNS:
            rows += [panels[at : at + COLUMNS] for at in range(0, len(panels), COLUMNS)]
        else:
            rows[-1] += panels
    return [row for row in rows if row]


def _panel(ax: Any, scores: pd.DataFrame) -> None:
    """Mean and median error against the value: seeds as points, their mean as a line."""
    origins = scores.groupby("value")["origin"].first()
    at = np.arange(len(origins))
    for i, (column, name) in enumerate({"mean": "mean", "median": "median"}.items()):
        by_seed = scores.groupby(["seed", "value"])[column].mean().unstack("value")
        style = line_style(i)
        label = f"{name} over episodes"
        ax.plot(at, by_seed.mean(), lw=1.3, marker="os"[i], mfc="white", ms=5, label=label, **style)
        for _, errors in by_seed.iterrows():
            ax.plot(at, errors, ls="", marker="os"[i], ms=2.5, color=style["color"])
        for x in at[np.isinf(by_seed.mean())]:
            ax.text(x, 0.99, "∞", transform=ax.get_xaxis_transform(), ha="center", va="top")
    final = at[origins == "final"][0]
    ax.axvline(final, color=GREY, lw=1, ls="dotted", label="the paper's final value")
    ax.plot([], [], ls="", marker="$*$", color=INK, label="beyond the paper's sweep")
    ax.set_yscale("log")
    ax.margins(y=0.15)
    ax.set_xticks(at, [shown(value) + "*" * (o == "beyond") for value, o in origins.items()])
    ax.set_xlim(-0.4, len(at) - 0.6)
    first = scores.iloc[0]
    how = "" if first["actions"] == "none" else f", {ACTIONS[first['actions']]} actions"
    ax.set_title(f"{first['task']}{how}", loc="left", fontsize=9)
    ax.set_xlabel(first["parameter"])
    ax.tick_params(which="both", labelsize=8)
    tidy(ax)
