"""Text of the study of uncertainty, from its tables alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import rounded
from benchmarks.paper._uncertainty_models import DESCRIPTIONS, TEST, VARIANTS

#: What a calibrated interval of 90 % should cover, and the most that calibration may cost.
TARGET, COST = (0.88, 0.92), 1.02
#: Horizons whose growth is compared.
GROWTH = (10, 200)
_KEYS = ["task", "noise", "model", "first", "last"]
#: Measures of quality that are averaged over bins, by what the table calls them.
QUALITY = {
    "spread_skill": "spread / error",
    "error_std_correlation": "correlation of error and std",
    "calibration_error": "calibration error",
}


def report(tables: Tables) -> str:
    """Target, scores, growth, small sets, whole trajectories, flights, and what is missing."""
    scores = tables["scores"]
    main = observed(scores)
    lines = [*_introduction(main), "", "### Target", "", *target(main), ""]
    for (task, noise), some in main.groupby(["task", "noise"], sort=False):
        lines += [f"### {place(task, noise)}", "", *_of_task(some), ""]
        true = scores[
            (scores["truth"] == "true") & (scores["task"] == task) & (scores["noise"] == noise)
        ]
        if len(true):
            lines += ["CRPS x 1000 against the true states, conformal:", ""]
            lines += [markdown(by_bin(true[true["kind"] == "conformal"], "crps", 1000)), ""]
    lines += ["### Does the uncertainty explode?", "", *_growth(tables["growth"]), ""]
    lines += ["### Few calibration episodes", "", *_small(scores), ""]
    lines += ["### Whole trajectories", "", *_whole(tables["whole"]), ""]
    if len(tables["samples"]):
        lines += ["### Samples instead of Gaussians", "", *_samples(tables["samples"]), ""]
    if "flights" in tables:
        lines += ["### Real flights", "", *_flights(tables["flights"]), ""]
        lines += [markdown(growth_table(tables["flights-growth"].assign(task="real", noise=0.0)))]
        lines += [""]
    lines += ["### CPU seconds of one thread", "", markdown(_seconds(tables["seconds"])), ""]
    lines += ["### What was run", "", *(f"- {line}" for line in _parts(tables["parts"]))]
    return "\n".join(lines)


def _introduction(main: pd.DataFrame) -> list[str]:
    seeds = main["seed"].nunique()
    lines = [
        f"Mean over {seeds} seed{'s' * (seeds > 1)} (least to greatest). Coverage: share of "
        "measured states inside the 90 % interval. Measurement noise is in standard deviations of "
        "each state, in training, calibration and test episodes. CRPS in thousandths of the "
        "training range of each state, averaged over states; NLL of the state in training ranges. "
        "Raw: as the model says. Conformal, variance: calibrated on other episodes, by quantiles "
        "of the residuals in standard deviations or by rescaling the variance.",
        "",
    ]
    there = set(main["model"])
    return lines + [f"- {name}: {text}." for name, text in DESCRIPTIONS.items() if name in there]


def observed(scores: pd.DataFrame) -> pd.DataFrame:
    """Scores against what was measured, calibrated with all calibration episodes."""
    return scores[(scores["truth"] == "observed") & (scores["kind"] != "set")]


def place(task: Any, noise: Any) -> str:
    """A task as titles say it."""
    if task == "real":
        return "real flights"
    return f"{task}, {100 * noise:g} % noise" if noise else f"{task}, no measurement noise"


def steps(first: Any, last: Any) -> str:
    """A bin of horizons."""
    return f"{first}-{last}"


def over_seeds(values: pd.Series, unit: float = 1.0) -> str:
    """Mean over seeds and the range of them."""
    some = values.to_numpy(dtype=np.float64) * unit
    middle = rounded(some.mean())
    if len(some) == 1 or np.isinf(some).all():
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


# -- target -------------------------------------------------------------------------------


def checked(main: pd.DataFrame) -> pd.DataFrame:
    """Means over seeds: coverage and what calibration costs, of each bin.

    Columns ``covered`` and ``ratio`` (CRPS calibrated / raw; NaN where both are infinite), and
    ``full`` (whether all test episodes were forecast).
    """
    keep = [*_KEYS, "n_episodes"]
    conformal = main[main["kind"] == "conformal"].groupby(keep, sort=False)
    raw = main[main["kind"] == "raw"].groupby(keep, sort=False)["crps"].mean()
    table = conformal[["coverage90", "crps"]].mean()
    with np.errstate(invalid="ignore"):
        table["ratio"] = table["crps"] / raw
    table = table.rename(columns={"coverage90": "covered"}).reset_index()
    most = table.groupby(["task", "noise"])["n_episodes"].transform("max")
    return table.assign(full=table["n_episodes"] == most)


def target(main: pd.DataFrame) -> list[str]:
    """Whether calibrated intervals cover what they should, at what cost; exceptions by name."""
    table = checked(main)
    n_test = TEST["full"]
    lines = []
    for full, some in table.groupby("full", sort=False):
        which = f"all test episodes (up to {n_test:,})" if full else "fewer test episodes"
        inside = some["covered"].between(*TARGET)
        cheap = some["ratio"] <= COST
        lines.append(
            f"- Forecasts of {which}: the calibrated 90 % interval covers {TARGET[0]:.0%} to "
            f"{TARGET[1]:.0%} in {inside.sum()} of {len(some)} cells (task, noise, model, bin; "
            f"mean over seeds); CRPS at most {COST:g} times the raw one in {cheap.sum()} of "
            f"{len(some)}."
        )
        for what, missed, column in (
            ("Coverage outside", some[~inside], "covered"),
            ("CRPS above", some[~cheap], "ratio"),
        ):
            if len(missed):
                lines.append(f"  {what}: {_named(missed, column)}.")
    return lines


def _named(missed: pd.DataFrame, column: str) -> str:
    parts = []
    for (task, noise, model), few in missed.groupby(["task", "noise", "model"], sort=False):
        values = [
            f"{steps(line.first, line.last)}: {rounded(getattr(line, column), 3)}"
            for line in few.rename(columns={column: column}).itertuples()
        ]
        parts.append(f"{place(task, noise)}, {model} ({', '.join(values)})")
    return "; ".join(parts)


# -- one task -----------------------------------------------------------------------------


def _of_task(some: pd.DataFrame) -> list[str]:
    few = _sizes(some)
    lines = [few, ""] if few else []
    for title, column, unit, kinds in (
        ("Coverage of the 90 % interval:", "coverage90", 1, ["raw", "conformal", "variance"]),
        ("CRPS x 1000:", "crps", 1000, ["raw", "conformal"]),
        ("NLL:", "nll", 1, ["raw", "conformal"]),
    ):
        lines += [title, "", markdown(by_bin(some[some["kind"].isin(kinds)], column, unit)), ""]
    lines += ["Mean over the bins of horizons:", "", markdown(_quality(some)), ""]
    return [*lines, sharpest(some), *_diverged(some)]


def _sizes(some: pd.DataFrame) -> str:
    """Models with fewer episodes than the others."""
    sizes = some[some["kind"] == "conformal"].groupby("model", sort=False)
    each = sizes[["n_calibration", "n_episodes"]].max()
    most = each.max()
    fewer = each[(each < most).any(axis=1)]
    parts = [f"{m} {n:.0f} / {k:.0f}" for m, n, k in fewer.itertuples()]
    text = f"Calibration / test episodes: {most.iloc[0]:.0f} / {most.iloc[1]:.0f}"
    return text + (f"; fewer for {'; '.join(parts)}." if parts else ".")


def _quality(some: pd.DataFrame) -> pd.DataFrame:
    lines = []
    full = some[some["kind"].isin(["raw", "conformal"])]
    for (model, kind), few in full.groupby(["model", "kind"], sort=False):
        by_seed = few.groupby("seed")[list(QUALITY)].mean()
        line = {"model": model, "": kind}
        lines.append(line | {title: over_seeds(by_seed[name]) for name, title in QUALITY.items()})
    return pd.DataFrame(lines)


def sharpest(some: pd.DataFrame) -> str:
    """The model with the least CRPS in each bin, after calibration."""
    few = some[some["kind"] == "conformal"]
    means = few.groupby(["first", "last", "model"], sort=False)["crps"].mean()
    parts = []
    for (first, last), values in means.groupby(["first", "last"], sort=False):
        ordered = values.droplevel(["first", "last"]).sort_values(kind="stable")
        name, best = ordered.index[0], ordered.iloc[0]
        said = f"steps {steps(first, last)}: {name} ({rounded(1000 * best)})"
        if len(ordered) > 1:
            said += f" before {ordered.index[1]} ({rounded(1000 * ordered.iloc[1])})"
        parts.append(said)
    return f"Least CRPS x 1000 of the calibrated forecasts, {'; '.join(parts)}."


def _diverged(some: pd.DataFrame) -> list[str]:
    raw = some[(some["kind"] == "raw") & (some["n_diverged"] > 0)]
    most = raw.groupby(["model", "seed"], sort=False)[["n_diverged", "n_episodes"]].max()
    by_model = most.groupby("model", sort=False).sum()
    parts = [f"{name}: {n} of {of}" for name, n, of in by_model.itertuples()]
    return ["", f"Diverged (outside every interval, infinite CRPS): {'; '.join(parts)}."] * bool(
        parts
    )


# -- growth -------------------------------------------------------------------------------


def growth_table(growth: pd.DataFrame) -> pd.DataFrame:
    """How much std and error grow between two horizons, and their quotient at both.

    Of each model the median over seeds.
    """
    first, last = GROWTH[0], int(min(GROWTH[1], growth["horizon"].max()))
    lines = []
    for (task, noise, model), some in growth.groupby(["task", "noise", "model"], sort=False):
        wide = some.pivot(index="seed", columns="horizon", values=["std", "error"])
        with np.errstate(divide="ignore", invalid="ignore"):
            times = {c: wide[c][last] / wide[c][first] for c in ("std", "error")}
            ratio = {h: (wide["std"][h] / wide["error"][h]).median() for h in (first, last)}
        line = {"task": place(task, noise), "model": model}
        line |= {f"std x ({first} to {last})": rounded(times["std"].median())}
        line |= {"error x": rounded(times["error"].median())}
        line |= {f"std / error at {h}": rounded(value) for h, value in ratio.items()}
        line |= {f"std at {last} / range": rounded(wide["std"][last].median())}
        lines.append(line)
    return pd.DataFrame(lines)


def _growth(growth: pd.DataFrame) -> list[str]:
    return [
        "Root mean square over states, median over test episodes, in training ranges, of the raw "
        "standard deviation and of the error. A std that grows as the error does is no explosion: "
        "it says what is the case. Median over seeds.",
        "",
        markdown(growth_table(growth)),
    ]


# -- few episodes, whole trajectories, flights ----------------------------------------------


def _small(scores: pd.DataFrame) -> list[str]:
    some = scores[scores["kind"] == "set"]
    if some.empty:
        return ["No small sets were tried."]
    lines = []
    by = some.groupby(["task", "noise", "model", "n_calibration"], sort=False)
    for (task, noise, model, n), cell in by:
        line = {"task": place(task, noise), "model": model, "calibration episodes": n}
        for (first, last), values in cell.groupby(["first", "last"]):
            line[steps(first, last)] = over_seeds(values["coverage90"])
        line["bootstrap +-"] = rounded(((cell["high"] - cell["low"]) / 2).mean())
        lines.append(line)
    return [
        "Coverage of the 90 % interval: mean over seeds and over sets of calibration episodes that "
        "share none (least to greatest). The half width of the 95 % bootstrap interval over test "
        "episodes, mean over bins, says nothing of the draw of the calibration episodes: the range "
        "does.",
        "",
        markdown(pd.DataFrame(lines)),
    ]


def _whole(whole: pd.DataFrame) -> list[str]:
    lines = []
    for (task, noise, model), some in whole.groupby(["task", "noise", "model"], sort=False):
        line = {"task": place(task, noise), "model": model}
        for kind, few in some.groupby("kind", sort=False):
            line[str(kind)] = over_seeds(few["state"])
        joint = some[some["kind"] == "simultaneous"]["joint"]
        lines.append(line | {"all states": over_seeds(joint)})
    return [
        "Share of trajectories that stay inside the 90 % interval at every step, of one state "
        "(mean over states); of the simultaneous bands also of all states together.",
        "",
        markdown(pd.DataFrame(lines)),
    ]


def _samples(samples: pd.DataFrame) -> list[str]:
    columns = {"gaussian": "Gaussian", "samples": "samples", "energy": "energy score"}
    lines = []
    for (task, noise, model), some in samples.groupby(["task", "noise", "model"], sort=False):
        for (first, last), cell in some.groupby(["first", "last"]):
            line = {"task": place(task, noise), "model": model, "steps": steps(first, last)}
            line |= {title: over_seeds(cell[c], 1000) for c, title in columns.items()}
            lines.append(line)
    n, episodes = samples["n_samples"].iloc[0], samples["n_episodes"].iloc[0]
    return [
        f"CRPS x 1000 of raw forecasts, of the Gaussian with their mean and standard deviation and "
        f"of {n} sampled trajectories, on {episodes} test episodes; and the energy score x 1000 of "
        "the joint state.",
        "",
        markdown(pd.DataFrame(lines)),
    ]


def _flights(flights: pd.DataFrame) -> list[str]:
    lines = []
    for (model, kind), some in flights.groupby(["model", "kind"], sort=False):
        line = {"model": model, "": kind}
        for (first, last), cell in some.groupby(["first", "last"]):
            low, high = cell["low"].iloc[0], cell["high"].iloc[0]
            share = cell["coverage90"].mean()
            line[steps(first, last)] = f"{rounded(share)} [{rounded(low)}, {rounded(high)}]"
        lines.append(line)
    n = flights.groupby(["model", "kind", "seed", "first"])["n_episodes"].max().max()
    return [
        f"{n} pieces of flights, folds by experiment: one fold calibrates, one is tested, the "
        "others train. P and PE are told the logged actions, and the one before; TPE and T are "
        "told the set-point and the gains. Coverage of the 90 % interval [95 % bootstrap interval, "
        "experiments drawn with replacement]; mean over seeds.",
        "",
        markdown(pd.DataFrame(lines)),
        "",
        "CRPS x 1000:",
        "",
        markdown(by_bin(flights, "crps", 1000)),
        "",
        sharpest(flights),
        *_diverged(flights),
        "",
    ]


def _seconds(seconds: pd.DataFrame) -> pd.DataFrame:
    by = seconds.groupby(["task", "model"], sort=False)[["fit", "forecast"]].median()
    by = by.rename(columns={"fit": "fit", "forecast": "1,000 forecasts"})
    return by.reset_index()


def _parts(parts: pd.DataFrame) -> list[str]:
    lines = []
    for ran, title in ((True, "Run"), (False, "Not run")):
        some = parts[parts["run"] == ran]
        names = [_part(line) for line in some.itertuples()]
        lines.append(f"{title}: {'; '.join(names) or 'nothing'}.")
    only = [v for some in VARIANTS.values() for v in some if v.task is not None]
    lines += [f"{v.name}: on {v.task} alone, for its cost." for v in only]
    return [*lines, *_how(parts)]


def _part(line: Any) -> str:
    where = "real flights" if line.task == "real flights" else place(line.task, line.noise)
    return f"{where} ({line.cells} cells)"


def _how(parts: pd.DataFrame) -> Sequence[str]:
    missing = parts[~parts["run"].astype(bool)]["task"]
    lines = []
    if (missing != "real flights").any():
        lines.append("More noise: `trajlearn reproduce uncertainty --more`.")
    if (missing == "real flights").any():
        lines.append("Real flights: `--data FOLDER`.")
    return lines
