"""Text of the study of real flights, from its tables alone."""

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._flights_data import ATTITUDE
from benchmarks.paper._flights_models import LOGGED
from benchmarks.paper._flights_tables import ALL, GAINS, MAIN
from benchmarks.paper._intervals import rounded, spread

_AT = (1, 10, 50, 200)
_T = GAINS[0]
_SPLITS = {"experiment": "Split by experiment", "block": "Split by blocks in time"}
_STARTS = {"later": "from later in the flight", "motion": "from the beginning of the motion"}


def report(tables: Tables) -> str:
    """Errors, what the gains add, when roll-outs diverge, and the ranking."""
    errors = tables["errors"]
    lines = [
        "Median over seeds (least to greatest). Driven axis: root mean square error along the "
        f"path, over flights of one group. {MAIN}, unless another is named. Attitude: root mean "
        "square of roll, pitch and yaw over all flights; without violent: without the few nearly "
        "unstable ones, which dominate every mean. nMSE: mean squared error of the 12 states in "
        "training ranges. A row with logged actions is told what the controller did after the "
        "start; no forecast before a flight could be.",
        "",
    ]
    for split, title in _SPLITS.items():
        for start, where in _STARTS.items():
            some = errors[(errors["split"] == split) & (errors["start"] == start)]
            if len(some):
                lines += [f"### {title}, {where}", "", markdown(_summary(some)), ""]
                lines += [_best(some), ""]
    lines += ["### Other groups", "", *_groups(errors), ""]
    lines += ["### What the gains add to T", "", *_gains(tables["gains"]), ""]
    lines += ["### Logged actions", "", *_logged(errors), ""]
    lines += ["### Between repeats", "", *_floor(tables["floor"]), ""]
    lines += ["### Ranking of held-out flights", "", *_ranking(tables["ranking"]), ""]
    return "\n".join(lines)


def _spread(values: pd.Series, unit: float = 1.0) -> str:
    there = values.dropna() * unit
    return spread(there) if len(there) else ""


def _summary(errors: pd.DataFrame) -> pd.DataFrame:
    """A line a row: driven axis, attitude and nMSE."""
    lines = []
    for row, some in errors.groupby("row", sort=False):
        line = {"row": row}
        main = some[some["group"] == MAIN]
        for h in _AT:
            line[f"driven mm, h = {h}"] = _spread(main[main["horizon"] == h]["driven_mm"])
        far = some[(some["group"] == ALL) & (some["horizon"] == 50)]
        for h in _AT[1:]:
            line[f"without violent, h = {h}"] = _spread(
                main[main["horizon"] == h]["driven_calm_mm"]
            )
        line["median flight, h = 50"] = _spread(main[main["horizon"] == 50]["driven_median_mm"])
        line["attitude deg, h = 50"] = _spread(far["attitude_deg"])
        line["attitude, without violent"] = _spread(far["attitude_calm_deg"])
        line["nMSE mean, h = 50"] = _spread(far["nmse"])
        line["median"] = _spread(far["nmse_median"])
        line["mean without violent"] = _spread(far["nmse_calm"])
        lines.append(line)
    return pd.DataFrame(lines)


def _middle(errors: pd.DataFrame, group: str, column: str) -> pd.DataFrame:
    """Median over seeds, a line a row and a column a horizon."""
    some = errors[errors["group"] == group]
    return some.groupby(["row", "horizon"], sort=False)[column].median().unstack("horizon")


def _best(errors: pd.DataFrame) -> str:
    """The best row without logged actions, and the place of T, horizon by horizon."""
    parts = []
    for column, group, what in (
        ("driven_mm", MAIN, "Driven axis"),
        ("nmse_median", ALL, "Median nMSE"),
    ):
        middle = _middle(errors, group, column).drop(index=list(LOGGED), errors="ignore")
        said = []
        for h in middle.columns:
            order = middle[h].dropna().sort_values()
            if _T not in order.index:
                continue
            place, ratio = order.index.get_loc(_T) + 1, order[_T] / order.iloc[0]
            own = "" if place == 1 else f" (T is number {place}, {rounded(ratio)} times)"
            said.append(f"h = {h} {order.index[0]}{own}")
        parts.append(f"{what}, best of the rows without logged actions: " + "; ".join(said) + ".")
    return " ".join(parts).replace("T is", f"{_T} is")


def _groups(errors: pd.DataFrame) -> list[str]:
    """Driven axis of every group, later starts."""
    lines = []
    rows = ("mean flight", "kernel ridge", _T, "T, kernel ridge", "C", "average")
    later = errors[(errors["start"] == "later") & errors["row"].isin(rows)]
    for (split, group), some in later.groupby(["split", "group"], sort=False):
        if group in (ALL, MAIN):
            continue
        for row, own in some.groupby("row", sort=False):
            line = {"split": split, "group": group, "row": row}
            for h in _AT:
                line[f"driven mm, h = {h}"] = _spread(own[own["horizon"] == h]["driven_mm"])
            lines.append(line)
    return [markdown(pd.DataFrame(lines))] if lines else ["There are none."]


def _gains(table: pd.DataFrame) -> list[str]:
    lines = [
        f"Error of {GAINS[0]} over that of the same model without gains (root mean square, later "
        "starts, squared errors averaged over seeds; 90 % of a bootstrap over experiments). Below "
        "1 the gains help.",
        "",
    ]
    shown = []
    for (split, group, quantity), some in table.groupby(["split", "group", "quantity"], sort=False):
        line = {"split": split, "group": group, "error": quantity}
        for h in (10, 50, 200):
            at = some[some["horizon"] == h].iloc[0]
            line[f"h = {h}"] = " ".join(
                [rounded(at["ratio"]), f"({rounded(at['low'])} to {rounded(at['high'])})"]
            )
        shown.append(line)
    lines += [markdown(pd.DataFrame(shown)), ""]
    for split, some in table[table["group"] == MAIN].groupby("split", sort=False):
        at = some[some["horizon"] == 200].set_index("quantity")
        sure = "sure" if at.loc["driven", "high"] < 1 else "not sure"
        lines.append(
            f"{_SPLITS[split]}, h = 200: {rounded(at.loc['driven', 'ratio'])} along the driven "
            f"axis ({sure}), {rounded(at.loc['12 states', 'ratio'])} over the 12 states, which "
            "are mostly wobble that no gain explains."
        )
    return lines


def _logged(errors: pd.DataFrame) -> list[str]:
    """When a row with logged actions becomes worse than the mean flight."""
    lines = []
    for split, some in errors[errors["start"] == "later"].groupby("split", sort=False):
        middle = _middle(some, ALL, "nmse")
        for row in LOGGED:
            if row not in middle.index:
                continue
            worse = [h for h in middle.columns if middle.loc[row, h] > middle.loc["mean flight", h]]
            better = (
                [h for h in middle.columns if middle.loc[row, h] < middle.loc[_T, h]]
                if _T in middle.index
                else []
            )
            ahead = f"less error than T at h = {_said(better)}" if better else "never ahead of T"
            beyond = f"more than the mean flight from h = {worse[0]}" if worse else "always useful"
            far = ", ".join(f"{rounded(middle.loc[row, h])} at {h}" for h in (5, 50, 200))
            lines.append(f"- {_SPLITS[split]}, {row}: {ahead}, {beyond}; nMSE {far}.")
    why = (
        "Why: the logged actions are what the controller commanded, in units that were not "
        "calibrated, and the motors lag behind them (the previous action tells some of that). "
        "They were right for the state that was flown, not for the predicted one: nothing pulls a "
        "roll-out back. They cannot be recomputed, because the integrators of the controller are "
        "not in the log."
    )
    return [*lines, "", why]


def _said(horizons: list[int]) -> str:
    return ", ".join(map(str, horizons))


def _floor(table: pd.DataFrame) -> list[str]:
    """What no model of the gains can predict."""
    lines = [
        "Standard deviation between flights with the same gains, and between all flights of a "
        "group, at the same phase: the least error that gains alone allow.",
        "",
    ]
    shown = []
    for group, some in table.groupby("group", sort=False):
        own = some.set_index("state")
        line = {"group": group, "repeats": str(int(own["n_repeats"].iloc[0]))}
        for name in ("x", "y", "z", "roll", "pitch"):
            unit, scale = ("deg", 180 / np.pi) if name in ATTITUDE else ("mm", 1e3)
            both = own.loc[name, ["repeats", "between"]].to_numpy(dtype=float) * scale
            line[f"{name} {unit}"] = " of ".join("?" if np.isnan(v) else rounded(v) for v in both)
        shown.append(line)
    return [*lines, markdown(pd.DataFrame(shown))]


def _ranking(table: pd.DataFrame) -> list[str]:
    lines = [
        "Spearman correlation of the predicted with the flown tracking error (root mean square "
        "along the driven axes). Common: over the part of the motion that all flights log; full: "
        "flights of which the beginning is logged. Pooled over folds with its 90 % interval over "
        "experiments (of the first seed), and the mean inside folds. Log error: root mean square "
        "of the log of predicted over flown. Nearest in time: mean of the nearest experiments in "
        "the order of flying. Repeats: the other flights with the same gains.",
        "",
    ]
    shown = []
    main = table[table["group"] == MAIN]
    for (split, row), some in main.groupby(["split", "row"], sort=False):
        line = {"split": split, "row": row}
        for window, own in some.groupby("window", sort=False):
            first = own.iloc[0]
            between = f"[{rounded(first['pooled_lower'])}, {rounded(first['pooled_upper'])}]"
            line[f"{window}: pooled"] = f"{_spread(own['pooled'])} {between}"
            line[f"{window}: in folds"] = _spread(own["per_fold"])
            line[f"{window}: log error"] = _spread(own["log_error"])
            line[f"{window}: flights"] = str(int(first["n"]))
        shown.append(line)
    lines += [f"{MAIN}:", "", markdown(pd.DataFrame(shown)), ""]
    others = table[(table["window"] == "common") & (table["group"] != MAIN)]
    middle = others.groupby(["split", "row", "group"], sort=False)["pooled"].median()
    wide = middle.unstack("group").reset_index()
    return [*lines, "Other groups, common window, pooled:", "", markdown(wide)]
