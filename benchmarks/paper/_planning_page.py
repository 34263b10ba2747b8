"""The planning results as people read them: text from the tables alone."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import spread
from benchmarks.paper._planning_refit import LABELS
from benchmarks.paper._planning_trials import BAD, EVERY, LOOKED_AT, N_CHOICES, ordered

#: Planners of the paper's figure, from the best (it prints no numbers).
PAPER_ORDER = ["one-step in closed loop", "T in open loop", "one-step in open loop"]


def report(tables: Tables) -> str:
    """What planners earn and cost, what their model knew of the choice, and what data are worth."""
    flown, faced = tables["trials"], tables["choices"]
    lines = ["### Reward per step and planning time", ""]
    lines += [markdown(_summary(flown)), "", *_notes(flown), ""]
    lines += ["### What the models know of the choice", "", markdown(_known(faced)), ""]
    lines += [*_why(faced), ""]
    lines += ["### Data gathered while theta changes", "", *_data(tables)]
    return "\n".join(lines)


def _summary(flown: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for name in ordered(flown["planner"]):
        some = flown[flown["planner"] == name]
        seeds = some.groupby("seed")["return"].mean()
        lines.append(
            {
                "planner": name,
                "trials": len(some),
                "reward per step": f"{some['return'].mean():.3f} ± {some['return'].std():.3f}",
                "means of seeds": f"{seeds.min():.3f} to {seeds.max():.3f}",
                "median": f"{some['return'].median():.3f}",
                "fell": _falls(some),
                "decisions a trial": _number(some["n_decisions"].mean(), ".0f"),
                "ms a decision": _number(1000 * some["decision_s"].median(), ".3g"),
                "s a trial": _number(some["trial_s"].median(), ".3g"),
                "changes of theta": _number(some["changes"].mean(), ".0f"),
            }
        )
    return pd.DataFrame(lines)


def _falls(some: pd.DataFrame) -> str:
    fell = some[some["fell"]]
    return f"{len(fell)} (step {fell['steps'].median():.0f})" if len(fell) else "0"


def _number(value: float, how: str) -> str:
    return "" if np.isnan(value) else format(value, how)


def _notes(flown: pd.DataFrame) -> list[str]:
    """How to read the table, and what holding a decision does on the same trials."""
    text = [
        "Reward per step: mean and standard deviation over trials of all training seeds (1 is the "
        "most); fell: trials that ended early, and at which step in the median. Planners that "
        "decide often share their trials out among the seeds: compare them on the same trials, "
        f"below. T gives the reward of every {EVERY}th step, linear in between, D that of each. "
        "Times are wall clock on one core, median over trials. References: the LQR, gains at "
        "random, and random shooting on the simulator itself, held all along. The paper's figure "
        "has three bars, best first: "
        f"{', '.join(PAPER_ORDER)}; it has no T in closed loop.",
        "",
    ]
    for one, other in [
        ("T, hold 25", "T, hold all"),
        ("T, hold 1", "T, hold all"),
        ("T, hold 1", "D over policies, hold all"),
        ("T, hold 1", "D over actions, hold 1, horizon 25"),
        ("T, hold 1", "T, hold 1, horizon 25"),
        ("T, hold all", "LQR"),
    ]:
        text.append(f"- {_paired(flown, one, other)}")
    return text


def _paired(flown: pd.DataFrame, one: str, other: str) -> str:
    """How two planners compare on the trials that both have flown."""
    table = flown.pivot(index=["seed", "trial"], columns="planner", values="return")
    if not {one, other} <= set(table.columns):
        return f"{one} and {other} were not both run."
    both = table[[one, other]].dropna()
    if not len(both):
        return f"{one} and {other} have no trial in common."
    gain = both[one] - both[other]
    return (
        f"{one} against {other}: {both[one].mean():.3f} and {both[other].mean():.3f} on the same "
        f"{len(both)} trials, better in {(gain > 0).sum()}."
    )


def _known(faced: pd.DataFrame) -> pd.DataFrame:
    """Of each model and step: its ranking of gains, and what its favourite is worth."""
    lines = []
    for (planner, model, step), some in faced.groupby(["planner", "model", "step"], sort=False):
        lines.append(
            {
                "trials of": planner,
                "step": step,
                "states": len(some),
                "model": model,
                "rank correlation": f"{some['rank'].median():.2f}",
                "favourite: predicted": f"{some['predicted'].mean():.3f}",
                "favourite: true": f"{some['true'].mean():.3f}",
                f"best of the {N_CHOICES}": f"{some['best'].mean():.3f}",
                f"mean of the {N_CHOICES}": f"{some['mean'].mean():.3f}",
                "bad gains": f"{100 * some['low'].mean():.1f} %",
                "bad favourites": f"{100 * some['pick_low'].mean():.0f} %",
            }
        )
    return pd.DataFrame(lines).sort_values(["trials of", "step"], kind="stable")


def _why(faced: pd.DataFrame) -> list[str]:
    """How to read the table, and what models make of the first state."""
    # there, all planners face the same choice
    first = faced[(faced["step"] == 0) & (faced["planner"] == LOOKED_AT[0])]
    told, bad = [], [f"{100 * first['low'].mean():.1f} % of the gains"]
    for model, some in first.groupby("model", sort=False):
        told.append(
            f"{model}: {some['predicted'].mean():.3f} predicted, {some['true'].mean():.3f} true, "
            f"with {some['speed_factor'].mean():.2f} and {some['rate_factor'].mean():.2f} times "
            "the LQR's gain on the cart's speed and on the pole's rate"
        )
        bad.append(f"{100 * some['pick_low'].mean():.0f} % of the favourites of {model}")
    return [
        f"At states of the trials that still run, {N_CHOICES} gains at random are held to the end "
        f"of the trial, in the model and in the simulator; per step. Bad: worth less than {BAD:g}. "
        "The log of both models has no episode that fell: T is asked for whole trials under given "
        "gains, D for single steps under given actions, one after another.",
        "",
        f"The favourite at the first state, on average: {'; '.join(told)}. Bad there: "
        f"{', '.join(bad)}.",
    ]


def _data(tables: Tables) -> list[str]:
    rows, errors, trials = tables["rows"], tables["errors"], tables["refits"]
    counts = rows.groupby(["hold", "horizon"], sort=False)["rows"].mean().unstack()
    lines = []
    for hold in (h for h in LABELS if h in set(trials["hold"])):
        line: dict[str, Any] = {"added": hold}
        for horizon in (1, 25, 100, 200):
            line[f"rows of {horizon}"] = f"{counts.loc[hold, horizon]:.0f}"
        own = errors[errors["hold"] == hold]
        for low, high in ((1, 25), (50, 200)):
            some = own[own["horizon"].between(low, high)].groupby("seed")["median"].mean()
            line[f"error, {low} to {high}"] = spread(some)
        for when in ("added", "next"):
            then = trials[(trials["hold"] == hold) & (trials["when"] == when)]
            line[f"{when} trials"] = (
                f"{then['return'].mean():.3f}, {then['fell'].sum():.0f} of {len(then)} fell"
                if len(then)
                else ""
            )
        lines.append(line)
    return [
        markdown(pd.DataFrame(lines)),
        "",
        "T is fitted on 20 episodes and what is added, a new fit each time. Rows: sub-trajectories "
        "of so many steps that the added trials have under constant theta, mean over seeds. "
        "Error: median squared error of new episodes from the planner's starts under random "
        "gains, those that did not fall (range of the first 20 episodes = 1), averaged over "
        "horizons; median over seeds (least to greatest). Added trials are planned with the first "
        "fit, next trials (hold 25) with the second, from new starts.",
    ]
