"""Text of the study of uncertainty, from its tables alone."""

from collections.abc import Iterator
from typing import Any

import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import rounded
from benchmarks.paper._tasks import N_EPISODES
from benchmarks.paper._uncertainty_flights import HORIZON, PARTICLES, STRIDE
from benchmarks.paper._uncertainty_growth import growth_table, verdict
from benchmarks.paper._uncertainty_models import DESCRIPTIONS, VARIANTS
from benchmarks.paper._uncertainty_tables import (
    at,
    by_bin,
    diverged,
    mean,
    observed,
    over_seeds,
    percent,
    place,
    sharpest,
    side_by_side,
    steps,
)
from benchmarks.paper._uncertainty_target import perfect_coverage, target

#: Measures of quality that are averaged over bins, by what the table calls them.
QUALITY = {
    "error_std_correlation": "correlation of error and std",
    "calibration_error": "calibration error",
}
# measure, unit and kinds of tables with several numbers in a cell
_COMPACT = {
    "Width of the 90 % interval x 1000": ("width", 1000, ["raw", "conformal"]),
    "NLL": ("nll", 1, ["raw", "conformal"]),
    "Coverage of the 90 % interval": ("coverage90", 1, ["conformal", "variance"]),
}


def report(tables: Tables) -> str:
    """Target, verdict and coverage; then the other scores, and what was run."""
    scores, seconds = tables["scores"], tables["seconds"]
    main = observed(scores)
    growth = tables["growth"]
    if "flights-growth" in tables:
        flown = tables["flights-growth"].assign(task="real", noise=0.0)
        growth = pd.concat([growth, flown], ignore_index=True)
    lines = [*_introduction(main, seconds), "", "### Target", "", *target(main), ""]
    lines += ["### Does the uncertainty of one-step models explode, and that of trajectory models"]
    lines[-1] += " not?"
    lines += ["", *verdict(growth), "", "### Coverage of the 90 % interval", ""]
    lines += ["Rows 'variance' are among the scores below.", ""]
    for title, some in _by_place(main):
        lines += [f"#### {title}", "", *_coverage(some), ""]
    if "flights" in tables:
        lines += ["### Real flights", "", *_flights(tables["flights"]), ""]
    lines += ["### Scores", ""]
    for title, some in _by_place(main):
        lines += [f"#### {title}: scores", "", *_scores(some), ""]
    true = scores[(scores["truth"] == "true") & (scores["kind"] == "conformal")]
    if len(true):
        lines += ["### CRPS x 1000 against the true states, conformal", ""]
    for title, some in _by_place(true):
        lines += [f"{title}:", "", markdown(by_bin(some, "crps", 1000)), ""]
    lines += ["### Growth of standard deviation and error", "", *_growth(growth), ""]
    lines += ["### Few calibration episodes", "", *_small(tables["sets"]), ""]
    lines += ["### Whole trajectories", "", *_whole(tables["whole"]), ""]
    if len(tables["samples"]):
        lines += ["### Samples instead of Gaussians", "", *_samples(tables["samples"]), ""]
    lines += ["### CPU seconds of one thread", "", markdown(_seconds(seconds)), ""]
    lines += ["### What was run", ""]
    lines += [f"- {line}" for line in _parts(tables["parts"], set(main["model"]))]
    return "\n".join(lines)


def _by_place(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for task, noise in table[["task", "noise"]].drop_duplicates().itertuples(index=False):
        yield place(task, noise), at(table, task, noise)


def _introduction(main: pd.DataFrame, seconds: pd.DataFrame) -> list[str]:
    seeds = main["seed"].nunique()
    lines = [
        f"Mean over {seeds} seed{'s' * (seeds > 1)} (least to greatest). Coverage: share of "
        "measured states inside the 90 % interval. Measurement noise is in standard deviations of "
        "each state, in training, calibration and test episodes. Widths and CRPS are in "
        "thousandths of the training range of each state, averaged over states; NLL of the state "
        "in training ranges.",
        "",
        "Rows 'raw' are what the model says. Rows 'conformal' and 'variance' are calibrated on "
        "other episodes. 'Conformal' takes coverage, width and calibration error from bands, of "
        "quantiles of the residuals in standard deviations; CRPS, NLL, spread and correlation from "
        "the Gaussian whose std was rescaled (by a factor and a floor per horizon and state) to "
        "the least CRPS of the calibration episodes. 'Variance' has the same Gaussian, and its "
        "intervals.",
        "",
    ]
    there = set(main["model"])
    lines += [f"- {name}: {text}." for name, text in DESCRIPTIONS.items() if name in there]
    return [*lines, "", *_particles(seconds)]


def _particles(seconds: pd.DataFrame) -> list[str]:
    drawn = seconds.drop_duplicates("model").dropna(subset="n_particles")
    parts = [
        f"{n:.0f} particles ({'; '.join(some['model'])}) {percent(perfect_coverage(int(n)))}"
        for n, some in drawn.groupby("n_particles", sort=False)
    ]
    if not parts:
        return []
    return [
        "Standard deviations from few particles scatter, so that raw 90 % intervals of a perfect "
        f"model would cover less than 90 %: by {'; by '.join(parts)}. The others draw none."
    ]


# -- one task -----------------------------------------------------------------------------


def _coverage(some: pd.DataFrame) -> list[str]:
    return [
        _sizes(some),
        "",
        markdown(by_bin(some[some["kind"] != "variance"], "coverage90")),
        "",
        sharpest(some),
        *diverged(some),
    ]


def _sizes(some: pd.DataFrame) -> str:
    """Episodes of most models, and models with fewer."""
    sizes = some[some["kind"] == "conformal"].groupby("model", sort=False)
    each = sizes[["n_calibration", "n_episodes"]].max()
    most = each.max()
    fewer = each[(each < most).any(axis=1)]
    parts = [f"{m} {n:.0f} / {k:.0f}" for m, n, k in fewer.itertuples()]
    text = f"Calibration / test episodes: {most.iloc[0]:.0f} / {most.iloc[1]:.0f}"
    return text + (f"; fewer for {'; '.join(parts)}." if parts else ".")


def _scores(some: pd.DataFrame) -> list[str]:
    full = some[some["kind"].isin(["raw", "conformal"])]
    lines = ["CRPS x 1000:", "", markdown(by_bin(full, "crps", 1000)), ""]
    for title, (column, unit, kinds) in _COMPACT.items():
        few = some[some["kind"].isin(kinds)]
        table = [
            {"model": model} | side_by_side(of_it, "kind", column, unit)
            for model, of_it in few.groupby("model", sort=False)
        ]
        lines += [f"{title}, {' / '.join(kinds)}, means over seeds:", ""]
        lines += [markdown(pd.DataFrame(table)), ""]
    return [
        *lines,
        "Spread / error: root mean variance over root mean squared error, from the least to the "
        "greatest bin of horizons; the others are means over the bins:",
        "",
        markdown(_quality(full)),
    ]


def _quality(full: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (model, kind), few in full.groupby(["model", "kind"], sort=False):
        spread = few.groupby("first")["spread_skill"].agg(mean).to_numpy()
        line = {"model": model, "": kind}
        line["spread / error"] = f"{rounded(spread.min())} to {rounded(spread.max())}"
        by_seed = few.groupby("seed")[list(QUALITY)].agg(mean)
        lines.append(line | {title: over_seeds(by_seed[name]) for name, title in QUALITY.items()})
    return pd.DataFrame(lines)


# -- growth, few episodes, whole trajectories, flights ----------------------------------------


def _growth(growth: pd.DataFrame) -> list[str]:
    return [
        "Root mean square over states, median over test episodes, in training ranges, of the raw "
        "standard deviation and of the error; then the median over seeds.",
        "",
        markdown(growth_table(growth)),
    ]


def _small(sets: pd.DataFrame) -> list[str]:
    lines = []
    by = sets.groupby(["task", "noise", "model", "n_calibration"], sort=False)
    for (task, noise, model, n), cell in by:
        line = {"task": place(task, noise), "model": model, "calibration episodes": n}
        for (first, last), values in cell.groupby(["first", "last"]):
            line[steps(first, last)] = _with_interval(values)
        lines.append(line)
    return [
        f"Every model is fitted on {N_EPISODES} episodes; only those for calibration are few. "
        "Coverage of the 90 % interval: mean over seeds and over sets of calibration episodes that "
        "share none [mean 95 % bootstrap interval over the test episodes] (least to greatest of "
        "the sets and seeds). The bootstrap knows nothing of the draw of the calibration episodes: "
        "the range does.",
        "",
        markdown(pd.DataFrame(lines)),
    ]


def _with_interval(values: pd.DataFrame) -> str:
    middle, low, high = (rounded(mean(values[name])) for name in ("coverage90", "low", "high"))
    covered = values["coverage90"]
    spread = f" ({rounded(covered.min())} to {rounded(covered.max())})" if len(values) > 1 else ""
    return f"{middle} [{low}, {high}]{spread}"


def _whole(whole: pd.DataFrame) -> list[str]:
    lines = []
    for title, here in _by_place(whole):
        for model, some in here.groupby("model", sort=False):
            line = {"task": title, "model": model}
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
    names = ["gaussian", "samples", "energy"]
    keys = ["task", "noise", "model"]
    scores = samples.melt([*keys, "first", "last"], names, var_name="of")
    lines = [
        {"task": place(task, noise), "model": model} | side_by_side(some, "of", "value", 1000)
        for (task, noise, model), some in scores.groupby(keys, sort=False)
    ]
    n, episodes = samples["n_samples"].iloc[0], samples["n_episodes"].iloc[0]
    return [
        "Of raw forecasts: CRPS x 1000 of the Gaussian with their mean and standard deviation / "
        f"CRPS x 1000 of {n} sampled trajectories / energy score x 1000 of the joint state; on "
        f"{episodes} test episodes, means over seeds.",
        "",
        markdown(pd.DataFrame(lines)),
    ]


def _flights(flights: pd.DataFrame) -> list[str]:
    lines = []
    for (model, kind), some in flights.groupby(["model", "kind"], sort=False):
        line = {"model": model, "": kind}
        for (first, last), cell in some.groupby(["first", "last"]):
            low, high = cell["low"].iloc[0], cell["high"].iloc[0]
            share = mean(cell["coverage90"])
            line[steps(first, last)] = f"{rounded(share)} [{rounded(low)}, {rounded(high)}]"
        lines.append(line)
    n, n_groups = flights["n_episodes"].max(), flights["n_groups"].iloc[0]
    return [
        f"{n} pieces of {n_groups} experiments: forecasts of {HORIZON} steps, one every {STRIDE}, "
        f"so that they overlap by up to {percent(1 - STRIDE / HORIZON)}. Folds by experiment: one "
        f"calibrates, about {flights['groups_of_fold'].iloc[0]:.0f} experiments, one is tested, "
        "the others train. The guarantee, for independent episodes, does not hold here. P and PE "
        "are told the logged actions, which a planner would not know, and the one before; their "
        f"std is that of {PARTICLES} particles. TPE and T are told the set-point and the gains. "
        "Coverage of the 90 % interval, mean over seeds "
        "[95 % bootstrap interval, which draws the tested experiments anew, not the calibration].",
        "",
        markdown(pd.DataFrame(lines)),
        "",
        "CRPS x 1000:",
        "",
        markdown(by_bin(flights, "crps", 1000)),
        "",
        sharpest(flights),
        *diverged(flights),
    ]


def _seconds(seconds: pd.DataFrame) -> pd.DataFrame:
    by = seconds.groupby(["task", "model"], sort=False)[["fit", "forecast"]].median()
    return by.rename(columns={"forecast": "1,000 forecasts"}).reset_index()


# -- what was run -------------------------------------------------------------------------

_MISSING = {
    "full": "Left out by the quick mode, which also trains the networks for fewer steps",
    "more": "Not run, other noise (`trajlearn reproduce uncertainty --more`)",
    "data": "Not run, for want of the recorded flights (`--data FOLDER`)",
}


def _parts(parts: pd.DataFrame, models: set[str]) -> list[str]:
    lines = []
    for key, title in ({"nothing": "Run"} | _MISSING).items():
        some = parts[parts["needs"] == key]
        if len(some):
            lines.append(f"{title}: {'; '.join(_part(line) for line in some.itertuples())}.")
    only = [v for some in VARIANTS.values() for v in some if v.task is not None]
    return lines + [f"{v.name}: on {v.task} alone, for its cost." for v in only if v.name in models]


def _part(line: Any) -> str:
    where = "real flights" if line.task == "real flights" else place(line.task, line.noise)
    return f"{where} ({line.cells} cells)"
