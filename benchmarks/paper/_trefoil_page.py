"""The real quadrotor in text and figures, from its tables alone."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._figures import (
    draw_curve,
    draw_percentiles,
    horizon_axes,
    legend_below,
    over_seeds,
)
from benchmarks.paper._intervals import rounded, spread
from benchmarks.paper._rollouts import PRINTED_GAIN, shown_horizons
from benchmarks.paper._trefoil import BASELINES, LENGTH, PAPER, STATES, STRIDE, WINDOWS
from trajlearn.plotting._style import GREY, tidy

TITLES = {"short": "short, 1-25", "long": f"long, 51-{LENGTH}"}
SCORED = {"attitude": "roll, pitch, wx, wy, wz", "all": "all twelve states"}
# look of a line: the models of the other figures have theirs; in-sample, the same colour
STYLES = {"D, logged": 0, "PE, logged": 1, "LSTM, logged": 2, "T": 3, "T (ours)": 4}
STYLES |= {"T, tracking error (ours)": 5, "mean flight": 6, "hold": 7}
STYLES |= {"D, in-sample": 12, "T, in-sample": 9}
UNITS = {"roll": "rad", "pitch": "rad", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
PICTURED = {"D": 0, "T": 3, "T (ours)": 4}
LEFT_OUT = (
    "Left out: its flights were not at hand. `--data FOLDER` names the folder that holds "
    "`nanobench_trefoil`; without it they are downloaded (`load_nanobench_trefoil`)."
)


# -- text ---------------------------------------------------------------------------------


def report(tables: Tables) -> list[str]:
    """Lines about the real flights; one line where there are none."""
    lines = ["### quadrotor-real", ""]
    if "real-episodes" not in tables:
        return [*lines, LEFT_OUT, ""]
    table = tables["real-episodes"]
    held = table[table["test"] == "held-out"]
    n_flights = held["flight"].nunique()
    n_windows = len(held[["flight", "window"]].drop_duplicates())
    lines += [
        f"A real Crazyflie under its default PID, the same gains in all of {n_flights} flights "
        f"along one trefoil: {n_windows} windows of {LENGTH:,} steps (10 s) that start every "
        f"{STRIDE} steps and overlap. Each flight is held out in turn, and models are trained on "
        "the windows of the others. Median over the windows of a flight, median over flights and "
        f"seeds (least to greatest): {n_flights} flights are few, and no interval is honest. "
        "In-sample: tested on the windows of training, which is what the paper's panel shows. "
        "Actions are the logged PWM of the motors: there is no policy to recompute them. T (ours) "
        "and C (ours) know the reference, T (ours) also the time since take-off; models with the "
        "paper's settings know neither, and T's only input beside the state is the horizon. PE and "
        "LSTM, which take longest, are measured on the paper's five states only. A curve of the "
        "figure shows at a horizon the mean since the horizon shown before: up to "
        f"{np.diff(shown_horizons(LENGTH)).max()} steps.",
        "",
    ]
    for states, some in table.groupby("states", sort=False):
        lines += [f"#### {SCORED[str(states)]}", "", markdown(summary(some)), ""]
        lines += [*_best(some), *_judged(some), ""]
    return lines


def medians(table: pd.DataFrame) -> pd.DataFrame:
    """Median over the windows of each flight: a line a model, test, flight and seed."""
    by = ["model", "actions", "test", "flight", "seed"]
    return table.groupby(by, sort=False)[WINDOWS].median().reset_index()


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """A line a model: its errors on held-out flights, and those in-sample.

    Parameters
    ----------
    table : DataFrame
        Errors by window, of one set of states.
    """
    lines = []
    for (model, actions), some in medians(table).groupby(["model", "actions"], sort=False):
        line = {"model": model, "actions": actions}
        for test in ("held-out", "in-sample"):
            of_test = some[some["test"] == test]
            for window, title in TITLES.items():
                name = title if test == "held-out" else f"{title}, in-sample"
                line[name] = spread(of_test[window]) if len(of_test) else None
        own = table[(table["model"] == model) & (table["actions"] == actions)]
        diverged = np.isinf(own.loc[own["test"] == "held-out", WINDOWS]).any(axis=1)
        lines.append(line | {"diverged": f"{diverged.sum()} of {len(diverged)}"})
    return pd.DataFrame(lines)


def _best(table: pd.DataFrame) -> list[str]:
    """A line a window: the three best models on held-out flights."""
    held = medians(table[table["test"] == "held-out"])
    held = held.assign(line=lines_of(held))
    lines = []
    for window, title in TITLES.items():
        middle = held.groupby("line", sort=False)[window].median().sort_values(kind="stable")
        named = "; ".join(f"{line} {rounded(value)}" for line, value in middle.head(3).items())
        lines.append(f"- {title}, the three best: {named}.")
    return lines


def _judged(table: pd.DataFrame) -> list[str]:
    """How many times T's error others have far ahead, flight by flight; the paper's claim."""
    by_flight = medians(table)
    by_flight = by_flight.assign(line=lines_of(by_flight))
    middle = by_flight.groupby(["test", "line", "flight"], sort=False)["long"].median()
    lines = []
    for test in ("held-out", "in-sample"):
        own = middle[test]["T"]
        said = []
        known = {f"{m}, logged" for m in PAPER} | set(BASELINES)
        for line in [line for line in middle[test].index.unique("line") if line in known]:
            ratios = middle[test][line] / own
            each = ", ".join(rounded(value) for value in ratios)
            said.append(f"{line} {each}" + f" ({verdict(ratios)})" * (line not in BASELINES))
        lines.append(
            f"- {TITLES['long']}, {test}, times the error of T with the paper's settings, flight "
            f"by flight: {'; '.join(said)}."
        )
    low, high = PRINTED_GAIN
    return [*lines, f"- The paper prints {low} to {high} times, in-sample, on flights of its own."]


def verdict(ratios: Any) -> str:
    """What errors of another model in units of T's, flight by flight, say of the paper's claim."""
    if min(ratios) >= PRINTED_GAIN[0]:
        return "the claim holds"
    if min(ratios) > 1:
        return "T is better, by less"
    if max(ratios) < 1:
        return "T is worse"
    return "no side on all flights"


def lines_of(table: pd.DataFrame) -> "pd.Series[str]":
    """Models with their source of actions, such as "D, logged"."""
    return table["model"] + table["actions"].map({"logged": ", logged", "none": ""})


# -- figures ------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """Errors by horizon, and the states of one held-out window; nothing without flights."""
    if "real-curves" not in tables:
        return {}
    return {
        "horizon-error-quadrotor-real": _draw_errors(tables["real-curves"]),
        "state-predictions-quadrotor-real": _draw_states(tables["real-states"]),
    }


def _draw_errors(curves: pd.DataFrame) -> Any:
    """A column a set of states; the paper's models above, ours and the baselines below."""
    import matplotlib.pyplot as plt

    curves = curves.assign(line=lines_of(curves))
    held, in_sample = (curves["test"] == test for test in ("held-out", "in-sample"))
    as_paper = curves["model"].isin(PAPER)
    inside = curves[in_sample & curves["model"].isin(["D", "T"])]
    inside = inside.assign(line=inside["model"] + ", in-sample")
    known = curves["line"].isin(STYLES)
    above = pd.concat([curves[held & as_paper], inside])
    below = curves[held & known & (~as_paper | (curves["model"] == "T"))]
    figure, grid = plt.subplots(
        2, len(STATES), figsize=(9.5, 8.2), layout="constrained", sharey="col", squeeze=False
    )
    for (upper, lower), states in zip(grid.T, STATES, strict=True):
        for ax, some, percentiles in ((upper, above, True), (lower, below, False)):
            some = some[some["states"] == states]
            for line, curve in some.groupby("line", sort=False):
                if percentiles and "in-sample" not in str(line):
                    draw_percentiles(ax, curve, STYLES[str(line)], str(line))
                else:
                    over = over_seeds(curve, ["horizon"])
                    draw_curve(ax, over, STYLES[str(line)], str(line), band=("low", "high"))
            what = "paper's settings" if percentiles else "ours, baselines"
            horizon_axes(ax, title=f"quadrotor-real, {SCORED[states]}\n{what}")
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
    legend_below(figure, grid[0, 0], ncols=4, others=tuple(grid[1]))
    return figure


def _draw_states(table: pd.DataFrame) -> Any:
    """The truth, broad and pale, and the predictions over it, a panel a state."""
    import matplotlib.pyplot as plt

    names = list(table["state"].unique())
    figure, axes = plt.subplots(
        len(names), 1, figsize=(9.5, 1.0 + 1.55 * len(names)), layout="constrained", sharex=True
    )
    title = f"quadrotor-real, held-out window {table['window'].iloc[0]}"
    figure.suptitle(title, x=0.01, ha="left", size=10)
    for ax, name in zip(axes, names, strict=True):
        some = table[table["state"] == name]
        ax.plot(some["horizon"], some["truth"], color=GREY, lw=4, alpha=0.4, label="truth")
        for model, style in PICTURED.items():
            line = f"{model}, logged" if model == "D" else model
            draw_curve(ax, some.assign(middle=some[model]), style, line, band=None)
        middle, span = some["truth"].median(), np.ptp(some["truth"])
        low, high = ax.get_ylim()
        # a line far off does not squash the truth
        ax.set_ylim(max(low, middle - 1.5 * span), min(high, middle + 1.5 * span))
        ax.set_title(f"{name} ({UNITS[name]})", loc="left", fontsize=9)
        tidy(ax)
    axes[-1].set_xlabel("horizon (steps)")
    legend_below(figure, axes[0], ncols=len(PICTURED) + 1)
    return figure
