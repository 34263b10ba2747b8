"""Text of the smoothing benchmark, from its tables alone."""

from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import rounded, spread
from benchmarks.paper._rollouts import windows
from benchmarks.paper._tasks import QUADROTOR, shape
from benchmarks.paper.horizon_error import named_models

#: What models are trained on, as tables and legends say it.
LABELS = {"raw": "measured", "smoothed": "smoothed", "true": "true"}
# changes of an error that are called one, and costs of noise that are worth giving back
_CHANGE, _COST = 0.05, 1.5
_KEYS = ["start", "line"]
_PROCESS_NOISE = (
    "The plant has process noise that shifts every state, the angles as well, from step to step. A "
    "smooth motion has no such shifts: the smoother takes them for measurement noise."
)


def report(tables: Tables) -> str:
    """Errors of states and of forecasts, and how much of what noise costs smoothing gives back."""
    lines = [
        "The noise is independent, normal, and given in standard deviations of each state. "
        "Everything is the median over seeds, and (least to greatest) where there are several.",
        "",
        "## States",
        "",
        "Root mean square error of the training states divided by the noise: measured states "
        "have 1. Filtered: from the measurements up to the state; smoothed: from the whole "
        "episode. Estimated: the noise as the smoother estimates it, divided by the true one. "
        "*fused*: one filter for a position and its measured velocity.",
        "",
    ]
    for task, some in tables["states"].groupby("task", sort=False):
        lines += _states(str(task), some, tables["choice"])
    lines += [
        "## Forecasts",
        "",
        "Squared error against the true test states in units of the range of the true training "
        "states: mean over a window of horizons, median over test episodes. Models have our "
        "settings and are trained on measured, smoothed or true states. Forecasts start from "
        "measured test states; with smoothed training states from filtered ones, as behind a "
        "smoother in a pipeline.",
        "",
    ]
    errors = tables["errors"].assign(line=named_models(tables["errors"]))
    for task, some in errors.groupby("task", sort=False):
        lines += [f"### {task}", "", *_start_states(str(task), tables["starts"]), ""]
        for window, few in some.groupby("window", sort=False):
            lines += [f"Horizons {steps_of(str(window), str(task))}:", ""]
            lines += [markdown(error_table(few)), "", *_diverged(few)]
        far = some[some["window"] == "long"]
        lines += [
            f"What noise costs at horizons {steps_of('long', str(task))}: the error in multiples "
            "of that of the same model on noise-free data, and what smoothing divides it by "
            "(measured / smoothed, least to greatest over seeds). Given back: the share of the "
            "cost, in logarithms.",
            "",
            markdown(cost_table(far)),
            "",
            *verdicts(far),
            "",
            *_damped(far),
        ]
    return "\n".join(lines)


# -- states -------------------------------------------------------------------------------


def _states(task: str, states: pd.DataFrame, choice: pd.DataFrame) -> list[str]:
    used = states[states["used"]]
    (name,) = used["smoother"].unique()
    picked = choice[choice["task"] == task]["model"]
    voted = int((picked == name.removesuffix(", fused")).sum())
    return [
        f"### {task}",
        "",
        f"Smoother: {name}. The likelihood of other training episodes prefers this model in "
        f"{voted} of {len(picked)} filters.",
        "",
        *([_PROCESS_NOISE, ""] if task in QUADROTOR else []),
        markdown(state_table(used)),
        "",
        *state_sentences(used),
        "",
        "All smoothers, by the geometric mean over the states of the smoothed error:",
        "",
        markdown(_smoother_table(states)),
        "",
    ]


def state_table(states: pd.DataFrame) -> pd.DataFrame:
    """A line a state (of many, a kind of states), for each noise what is left of it.

    Parameters
    ----------
    states : DataFrame
        Of one task and smoother.
    """
    some = in_noise(states[states["noise"] > 0])
    kinds = some["state"].unique()
    if len(kinds) > 8:
        # cos_base_z and its like
        some = some.assign(state=some["state"].str.split("_").str[0])
    lines = []
    for state, few in some.groupby("state", sort=False):
        line = {"state": state}
        for noise, cell in few.groupby("noise"):
            mean = cell.groupby("seed")[["filtered", "smoothed", "estimated_noise"]].mean()
            for column, title in (("filtered", "filtered"), ("smoothed", "smoothed")):
                line[f"{title}, {percent(noise)}"] = spread(mean[column])
            line[f"estimated, {percent(noise)}"] = rounded(mean["estimated_noise"].median())
        lines.append(line)
    return pd.DataFrame(lines)


def state_sentences(states: pd.DataFrame) -> list[str]:
    """Which states smoothing helps, which it harms, and what it does to clean data."""
    lines = []
    for noise, some in states.groupby("noise"):
        if noise == 0:
            worst = some.loc[some["smoothed"].idxmax()]
            warned = some.groupby("state")["warned"].all()
            lines.append(
                f"- Without noise smoothing moves states by at most {rounded(worst['smoothed'])} "
                f"of their standard deviation ({worst['state']}); it warns of {warned.sum()} of "
                f"{len(warned)} states."
            )
            continue
        ratio = some.assign(ratio=some["smoothed"] / some["raw"]).groupby("state", sort=False)
        least, greatest = ratio["ratio"].min(), ratio["ratio"].max()
        lower, higher = greatest < 1 - _CHANGE, least > 1 + _CHANGE
        found = {
            "lowers the error": (lower, least[lower], greatest[lower]),
            "raises the error": (higher, least[higher], greatest[higher]),
        }
        parts = [
            f"{what} of {_listed(which.index[which], len(which))} (to between {rounded(low.min())} "
            f"and {rounded(high.max())} of the noise)"
            for what, (which, low, high) in found.items()
            if which.any()
        ]
        same = ~(lower | higher)
        if same.any():
            parts.append(
                f"hardly changes (by less than {_CHANGE:.0%}), or not in the same direction for "
                f"every seed, that of {_listed(same.index[same], len(same))}"
            )
        lines.append(f"- {percent(noise)} noise: smoothing {'; '.join(parts)}.")
    return lines


def _smoother_table(states: pd.DataFrame) -> pd.DataFrame:
    some = in_noise(states[states["noise"] > 0])
    lines = []
    for (name, used), few in some.groupby(["smoother", "used"], sort=False):
        line = {"smoother": f"**{name}**" if used else name}
        for noise, cell in few.groupby("noise"):
            logs = np.log(cell["smoothed"]).groupby(cell["seed"]).mean()
            line[percent(noise)] = spread(np.exp(logs))
        lines.append(line)
    return pd.DataFrame(lines)


def in_noise(states: pd.DataFrame) -> pd.DataFrame:
    """Errors in units of the noise that the states have."""
    columns = ["filtered", "smoothed", "estimated_noise"]
    return states.assign(**{c: states[c] / states["raw"] for c in columns})


def _listed(names: Iterable[str], of: int) -> str:
    some = list(names)
    return "all states" if len(some) == of else ", ".join(some)


def percent(noise: Any) -> str:
    """Noise as tables and figures say it."""
    return f"{100 * noise:g} %"


# -- forecasts ----------------------------------------------------------------------------


def _start_states(task: str, starts: pd.DataFrame) -> list[str]:
    """How much better the filter knows where a forecast starts."""
    some = starts[(starts["task"] == task) & (starts["noise"] > 0)]
    lines = []
    for start, few in some.groupby("start"):
        wide = few.pivot(index=["noise", "seed"], columns="states", values="error")
        ratio = (wide["smoothed"] / wide["raw"]).groupby("noise")
        parts = [f"{spread(values)} at {percent(noise)} noise" for noise, values in ratio]
        lines.append(
            f"- The error of state {start} of the test episodes, filtered / measured: "
            f"{', '.join(parts)}."
        )
    return lines


def error_table(errors: pd.DataFrame) -> pd.DataFrame:
    """A line a start, model and training set, a column a noise; of one task and window."""
    noises = np.sort(errors["noise"].unique())
    there = [states for states in LABELS if (errors["states"] == states).any()]
    orders = [np.sort(errors["start"].unique()), errors["line"].unique(), there]
    by = dict(list(errors.groupby([*_KEYS, "states", "noise"])["median"]))
    return pd.DataFrame(
        [
            {"start": start, "model": line, "trained on": LABELS[states]}
            | {
                percent(noise): spread(by[start, line, states, noise])
                for noise in noises
                if (start, line, states, noise) in by
            }
            for start, line, states in product(*orders)
        ]
    ).fillna("")


def _diverged(errors: pd.DataFrame) -> list[str]:
    lines = []
    for (line, states, noise), some in errors.groupby(["line", "states", "noise"], sort=False):
        n, of = some["n_diverged"].sum(), some["n_episodes"].sum()
        if n:
            lines.append(f"{line} on {LABELS[states]} states, {percent(noise)}: {n} of {of}")
    return [f"Diverged (infinite): {'; '.join(lines)}.", ""] if lines else []


def cost(errors: pd.DataFrame) -> pd.DataFrame:
    """Errors of each seed in multiples of those without noise.

    Parameters
    ----------
    errors : DataFrame
        Of one task and window, with names of lines.

    Returns
    -------
    DataFrame
        A line a start, line, noise and seed; columns ``raw``, ``smoothed``, ``true`` (multiples),
        ``gain`` (measured / smoothed) and ``share`` (of the cost, given back, in logarithms; NaN
        where noise costs next to nothing).
    """
    keys = [*_KEYS, "seed"]
    wide = errors.pivot(index=[*keys, "noise"], columns="states", values="median")
    wide = wide.reindex(columns=list(LABELS))
    clean = wide["raw"].xs(0, level="noise")
    wide = wide[wide.index.get_level_values("noise") > 0]
    of = clean.reindex(wide.index.droplevel("noise")).to_numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        table = wide.div(of, axis=0)
        table["gain"] = wide["raw"] / wide["smoothed"]
        share = np.log(table["gain"]) / np.log(table["raw"])
    table["share"] = share.where(table["raw"] > _COST)
    return table.reset_index()


def cost_table(errors: pd.DataFrame) -> pd.DataFrame:
    """`cost` for reading: a line a start, model and noise."""
    lines = []
    for (start, line, noise), some in _ordered(cost(errors), errors):
        row = {"start": start, "model": line, "noise": percent(noise)}
        for states, label in LABELS.items():
            known = some[states].notna().any()
            row[label] = f"x {rounded(some[states].median())}" if known else None
        # of the seeds together, not of one of them
        known = some["share"].notna().all()
        row["measured / smoothed"] = spread(some["gain"])
        row["given back"] = f"{some['share'].median():.0%}" if known else None
        lines.append(row)
    return pd.DataFrame(lines)


def verdicts(errors: pd.DataFrame) -> list[str]:
    """For every start, model and noise: whether smoothing lowers the error, for every seed."""
    parts: dict[tuple[Any, str], dict[str, list[str]]] = {}
    for (start, line, noise), some in _ordered(cost(errors), errors):
        if (some["gain"] > 1 + _CHANGE).all():
            verdict = "lowers the error"
        elif (some["gain"] < 1 - _CHANGE).all():
            verdict = "raises the error"
        else:
            verdict = "makes no difference that all seeds share"
        found = parts.setdefault((start, line), {})
        found.setdefault(verdict, []).append(percent(noise))
    lines = []
    for (start, line), found in parts.items():
        said = [f"{verdict} at {', '.join(noises)} noise" for verdict, noises in found.items()]
        lines.append(f"- {line}, from state {start}: smoothing {'; '.join(said)}.")
    return lines


def _damped(errors: pd.DataFrame) -> list[str]:
    """A word where models trained on noisy states look better than without noise."""
    some = cost(errors)
    better = some.groupby(["line", "noise"])["raw"].max() < 1 / _COST
    named = sorted({line for line, _ in better.index[better] if "logged" in line})
    if not named:
        return []
    return [
        f"Where noise seems to help ({'; '.join(named)}) it is no merit: with logged actions a "
        "good model of an unstable plant lets the error of its start grow as the plant does. Noise "
        "in the inputs damps what a one-step model learns, and less grows: a model trained on "
        "better states can forecast worse.",
        "",
    ]


def _ordered(costs: pd.DataFrame, errors: pd.DataFrame) -> Any:
    """Groups of start, line and noise; models as in the table of errors."""
    models = pd.CategoricalDtype(list(errors["line"].unique()), ordered=True)
    return costs.astype({"line": models}).groupby([*_KEYS, "noise"], observed=True)


def steps_of(window: str, task: str) -> str:
    """First and last horizon of a window."""
    length = shape(task).length
    steps = np.arange(1, length + 1)[windows(length)[window]]
    return f"{steps[0]} to {steps[-1]} ({window})"
