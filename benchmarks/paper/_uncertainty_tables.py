"""What all parts of the text on uncertainty share: places, numbers over seeds, tables by bin."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._intervals import rounded

#: How variants that replay the log are called; they know what a planner would not.
LOGGED = "logged actions"


def observed(scores: pd.DataFrame) -> pd.DataFrame:
    """Scores against what was measured."""
    return scores[scores["truth"] == "observed"]


def at(table: pd.DataFrame, task: str, noise: float) -> pd.DataFrame:
    """Lines of a task with a noise."""
    return table[(table["task"] == task) & (table["noise"] == noise)]


def place(task: Any, noise: Any) -> str:
    """A task as titles say it."""
    if task == "real":
        return "real flights"
    return f"{task}, {100 * noise:g} % noise" if noise else f"{task}, no measurement noise"


def steps(first: Any, last: Any) -> str:
    """A bin of horizons."""
    return f"{first}-{last}"


def percent(share: float) -> str:
    """A share in whole percent."""
    return f"{100 * share:.0f} %"


def mean(values: Any) -> float:
    """Mean in which NaN and infinity stay: what has no value in one seed has none."""
    return float(np.mean(np.asarray(values, dtype=np.float64)))


def over_seeds(values: pd.Series, unit: float = 1.0) -> str:
    """Mean over seeds and the range of them."""
    some = values.to_numpy(dtype=np.float64) * unit
    middle = rounded(mean(some))
    if len(some) == 1 or not np.isfinite(some).any():
        return middle
    return f"{middle} ({rounded(some.min())} to {rounded(some.max())})"


def by_bin(some: pd.DataFrame, column: str, unit: float = 1.0) -> pd.DataFrame:
    """A line a model (and kind), a column a bin of horizons."""
    lines = []
    for (model, kind), few in some.groupby(["model", "kind"], sort=False):
        line = {"model": model, "": kind}
        for (first, last), cell in few.groupby(["first", "last"]):
            line[steps(first, last)] = over_seeds(cell[column], unit)
        lines.append(line)
    return pd.DataFrame(lines)


def side_by_side(some: pd.DataFrame, by: str, column: str, unit: float = 1.0) -> dict[str, str]:
    """Of each bin the means over seeds of a column, one for each value of `by`."""
    return {
        steps(first, last): " / ".join(
            rounded(unit * mean(few[column])) for _, few in cell.groupby(by, sort=False)
        )
        for (first, last), cell in some.groupby(["first", "last"])
    }


def sharpest(some: pd.DataFrame) -> str:
    """The two models with the least CRPS in each bin, after calibration.

    Of those that were tested on most episodes, and not told the actions of the log.
    """
    few = some[(some["kind"] == "conformal") & ~some["model"].str.endswith(LOGGED)]
    few = few[few["n_episodes"] == few["n_episodes"].max()]
    means = few.groupby(["first", "last", "model"], sort=False)["crps"].agg(mean)
    parts = []
    for (first, last), values in means.groupby(["first", "last"], sort=False):
        ordered = values.droplevel(["first", "last"]).sort_values(kind="stable")
        parts.append(f"steps {steps(first, last)}: {_first_two(ordered)}")
    if not parts:
        return "No forecast of all test episodes without logged actions."
    return f"Least CRPS x 1000 of the calibrated forecasts, {'; '.join(parts)}."


def _first_two(ordered: pd.Series) -> str:
    if np.isinf(ordered.iloc[0]):
        return "all are infinite"
    printed = [rounded(1000 * value) for value in ordered.iloc[:2]]
    said = f"{ordered.index[0]} ({printed[0]})"
    if len(printed) == 1:
        return said
    if printed[0] == printed[1]:
        return f"{ordered.index[0]} and {ordered.index[1]} equal ({printed[0]})"
    return f"{said} before {ordered.index[1]} ({printed[1]})"


def diverged(some: pd.DataFrame) -> list[str]:
    """How many forecasts diverged, of all seeds together; nothing where none did."""
    raw = some[some["kind"] == "raw"]
    most = raw.groupby(["model", "seed"], sort=False)[["n_diverged", "n_episodes"]].max()
    by_model = most.groupby("model", sort=False).sum()
    by_model = by_model[by_model["n_diverged"] > 0]
    parts = [f"{name}: {n} of {of}" for name, n, of in by_model.itertuples()]
    if not parts:
        return []
    return ["", f"Diverged (outside every interval, infinite CRPS): {'; '.join(parts)}."]
