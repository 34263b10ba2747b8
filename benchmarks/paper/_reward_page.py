"""The reward table as people read it: in full, in short, and as a figure."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._rewards import FAR
from trajlearn.plotting._style import GREY, INK, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Kinds of settings, in the order in which they are shown; a constant has none.
SETTINGS = ["paper", "tuned", "default", "-"]
#: The figures that the paper prints: mean squared error and the std beside it.
PAPER = {
    "cartpole": {
        "GP": (0.884, 1.873),
        "NN": (0.446, 1.189),
        "D, logged actions": (0.057, 0.100),
        "D, predicted actions": (0.979, 1.725),
        "T": (0.010, 0.033),
    },
    "reacher": {
        "GP": (0.127, 0.192),
        "NN": (0.074, 0.112),
        "D, logged actions": (0.485, 2.048),
        "D, predicted actions": (0.072, 0.0932),
        "T": (0.005, 0.006),
    },
}
#: What every method needs, in the order in which they are shown.
MAPPING = {
    "GP": "(s_0, theta) -> R",
    "NN": "(s_0, theta) -> R",
    "D, logged actions": "(s_0, a_0 ... a_L) -> R",
    "D, predicted actions": "(s_0, theta, policy) -> R",
    "D, polynomial, logged actions": "(s_0, a_0 ... a_L) -> R",
    "D, polynomial, predicted actions": "(s_0, theta, policy) -> R",
    "C": "(s_0, theta) -> R",
    "T": "(s_0, theta) -> R",
    "T, features": "(s_0, theta, policy) -> R",
    "T, GP": "(s_0, theta) -> R",
    "constant": "mean training reward",
}
#: How each kind of settings is called and marked in the figure.
MARKERS = {
    "paper": ("the paper's settings, actions aligned", "s"),
    "tuned": ("tuned", "o"),
    "default": ("library defaults", "^"),
}
#: Greatest error that is drawn.
CEILING = 10.0
UNITS = {
    "cartpole": "squared error of the mean of x² + θ² (m and rad)",
    "reacher": "squared error of the mean distance (m²)",
}


# -- table ----------------------------------------------------------------------------------------


def table(task: str, records: pd.DataFrame) -> pd.DataFrame:
    """One line a method: mean over seeds of the mean squared error, its spread, medians."""
    lines = []
    for (settings, row), some in records.groupby(["settings", "row"], sort=False):
        printed = PAPER[task].get(row) if settings == "paper" else None
        lines.append(
            {
                "settings": settings,
                "method": row,
                "predicts from": MAPPING[row],
                "MSE": some["mean"].mean(),
                "MSE std over seeds": _spread(some["mean"]),
                "std of squared error": some["std"].mean(),
                "median squared error": some["median"].median(),
                "MSE, own goals": some["own_goal"].mean(),
                "episodes": int(some["n_episodes"].sum()),
                "diverged": int(some["n_diverged"].sum()),
                "lost": some["n_far"].sum(min_count=1),
                "paper": None if printed is None else f"{printed[0]:g} ± {printed[1]:g}",
                "CPU seconds": some["seconds"].mean(),
            }
        )
    frame = pd.DataFrame(lines)
    frame["lost"] = frame["lost"].astype("Int64").astype(object).where(frame["lost"].notna())
    order = {method: i for i, method in enumerate(MAPPING)}
    return frame.sort_values(
        ["settings", "method"],
        key=lambda column: column.map(order if column.name == "method" else SETTINGS.index),
        ignore_index=True,
    )


def _spread(values: pd.Series) -> float:
    """Standard deviation over seeds; unknown of one seed, and of infinite errors."""
    return values.std(ddof=1) if len(values) > 1 and np.isfinite(values).all() else np.nan


def brief(task: str, records: pd.DataFrame) -> str:
    """Compact Markdown table for the README: one line a method, one column a kind of settings."""
    frame = table(task, records).set_index(["settings", "method"])
    own_goals = bool(frame["MSE, own goals"].notna().any())

    def entry(settings: str, method: str, column: str = "MSE") -> str:
        if (settings, method) not in frame.index:
            return ""
        line = frame.loc[(settings, method)]
        if not np.isfinite(line[column]):
            lost = f"{line['diverged']} of {line['episodes']} diverge"
            return lost if line["diverged"] else ""
        if column != "MSE" or pd.isna(line["MSE std over seeds"]):
            return f"{line[column]:.2g}"
        return f"{line['MSE']:.2g} ± {line['MSE std over seeds']:.1g}"

    columns = ["paper prints"] + ["its settings, own goals"] * own_goals
    columns += ["its settings, actions aligned", "tuned", "library defaults"]
    lines = ["| method | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    known = set(frame.index.get_level_values("method"))
    for method in (method for method in MAPPING if method in known):
        printed = PAPER[task].get(method)
        cells = ["" if printed is None else f"{printed[0]:g}"]
        cells += [entry("paper", method, "MSE, own goals")] * own_goals
        last = "-" if method == "constant" else "default"
        cells += [entry(settings, method) for settings in ("paper", "tuned", last)]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def report(tables: Tables) -> str:
    """The whole table, and the short one."""
    ((task, records),) = tables.items()
    frame = table(task, records).dropna(axis="columns", how="all")
    lines = [
        f"### {task}",
        "",
        "Squared error of the mean reward per step, mean over test episodes and seeds; "
        f'"lost": forecasts that leave the training states by more than {FAR:g} of their ranges.',
    ]
    if "MSE, own goals" in frame:
        lines.append(
            '"Own goals": every test episode has a goal of its own, as in the paper; GP and NN do '
            "not see goals. Otherwise all share the environment's goal."
        )
    return "\n".join([*lines, "", markdown(frame), "", brief(task, records)])


# -- figure ---------------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """A line a method, a marker a kind of settings: mean over seeds, and their range."""
    import matplotlib.pyplot as plt

    ((task, records),) = tables.items()
    methods = [method for method in MAPPING if (records["row"] == method).any()]
    methods.remove("constant")
    size = (7.4, 1.3 + 0.4 * len(methods))
    figure, ax = plt.subplots(figsize=size, layout="constrained")
    ax.set_xscale("log")
    for i, (settings, (label, marker)) in enumerate(MARKERS.items()):
        some = records[records["settings"] == settings].groupby("row")
        colour = line_style(i)["color"]
        ax.plot([], [], marker, color=colour, mec="white", ms=7, label=label)
        for row, of_row in some:
            _draw_row(ax, methods.index(row) + 0.24 * (i - 1), of_row, marker, colour)
    printed = [PAPER[task].get(method, (np.nan,))[0] for method in methods]
    lines = np.arange(len(methods))
    own = "" if records["own_goal"].isna().all() else ", a goal an episode"
    label = f"printed in the paper{own}"
    ax.plot(printed, lines, "D", color="white", mec=INK, ms=7, label=label)
    guess = records.loc[records["row"] == "constant", "mean"].mean()
    ax.axvline(guess, color=GREY, lw=1, ls="dashed", label="constant: mean training reward")
    ax.set_xlim(right=CEILING)
    ax.set_yticks(lines, methods)
    ax.set_ylim(len(methods) - 0.5, -0.5)
    ax.hlines(lines[1:] - 0.5, 0, 1, transform=ax.get_yaxis_transform(), color="0.9", lw=0.8)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel(UNITS[task])
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    tidy(ax)
    return {task: figure}


def _draw_row(ax: "Axes", y: float, some: pd.DataFrame, marker: str, colour: str) -> None:
    """One row: a mean above the ceiling stands at the edge, with its value or what became of it."""
    errors = some["mean"]
    if errors.mean() <= CEILING:
        ax.plot([errors.min(), min(errors.max(), CEILING)], [y, y], color=colour, lw=1.5)
        ax.plot(errors.mean(), y, marker, color=colour, mec="white", ms=6)
        return
    ax.plot(CEILING, y, ">", color=colour, ms=6, clip_on=False)
    text = f"{errors.mean():.0e}"
    if not np.isfinite(errors).all():
        text = f"{some['n_diverged'].sum()} of {some['n_episodes'].sum()} diverge"
    at = ("axes fraction", "data")
    ax.annotate(text, (1.03, y), xycoords=at, va="center", fontsize=8)
