"""The page docs/audit.md, written from tables; not a number in it is typed by hand."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._claims import SAME, Claim, Comparison, from_tables, number
from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import spread

_HEAD = """# An audit of the paper's claims

N. Lambert et al., "Learning Accurate Long-term Dynamics for Model-based Reinforcement Learning"
(CDC 2021), claim by claim: what it says, what was measured here, and a verdict. Every number on
this page comes out of `trajlearn reproduce audit`, which reads the stored results of the other
benchmarks and takes the paper's protocol apart in ablations of its own.

Two protocols are measured side by side: the *paper's settings* (its networks, learning rates and
epochs) and *tuned* models (the library's defaults, with the same care for one-step and for
trajectory models). In both, actions are aligned: a_t takes s_t to s_t+1. A ratio above 1 speaks
for the claim. The interval behind it holds the middle 95 % of a bootstrap over test episodes; the
range is over training seeds. A comparison counts for or against a claim only if the interval and
every seed agree, otherwise it is open. *Holds* means that all comparisons speak for the claim,
*holds only if* that there are conditions under which all do (they are named), *fails* that there
are none.
"""


_PICTURE = "![Every comparison at a glance](../benchmarks/paper/results/audit/audit.png)"


def page(tables: Tables) -> str:
    """The page as Markdown, from the tables of the audit alone."""
    claims = from_tables(tables)
    parts = [_HEAD, "## Verdicts", "", markdown(_overview(claims)), "", _PICTURE, ""]
    parts += ["## Claim by claim", ""]
    for i, claim in enumerate(claims, 1):
        parts += _section(i, claim)
    parts += ["## Why the paper saw something else", "", *reasons(tables)]
    parts += ["## Where the numbers come from", "", markdown(tables["sources"])]
    return "\n".join(parts).rstrip() + "\n"


def _overview(claims: Sequence[Claim]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "claim": f"{i}. {claim.title}",
            "verdict": f"**{claim.verdict}**",
            "speak for it (ratios)": claim.effect("for"),
            "against": claim.effect("against"),
            "open": claim.effect("open"),
        }
        for i, claim in enumerate(claims, 1)
    )


def _section(i: int, claim: Claim) -> list[str]:
    lines = [f"### {i}. {claim.title}", "", f"*The paper:* {claim.says}", ""]
    lines += [f"*Verdict:* **{claim.verdict}**", "", *_conditions(claim)]
    lines += [*(f"{note}\n" for note in claim.notes)]
    if claim.figure:
        lines += [f"![{claim.title}](../benchmarks/paper/results/{claim.figure})", ""]
    lines += ["<details>", "<summary>All comparisons</summary>", ""]
    return [*lines, markdown(_comparisons(claim)), "", "</details>", ""]


def _conditions(claim: Claim) -> list[str]:
    """Under which conditions it holds, under which the opposite is true, and the rest."""
    if claim.verdict in ("holds", "not measured"):
        return []
    lines = {
        "It holds for": claim.conditions("for"),
        "The opposite holds for": claim.conditions("against"),
        "Mixed or open": claim.mixed(),
    }
    return [*(f"- {said}: {'; '.join(names)}." for said, names in lines.items() if names), ""]


def _comparisons(claim: Claim) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "condition": one.condition,
            "ratio": one.what,
            "value": number(one.estimate),
            "95 % interval": _interval(one),
            "seeds": f"{number(min(one.seeds))} to {number(max(one.seeds))}",
            "speaks": one.verdict + (f" (within a factor {SAME:g})" if one.same else ""),
        }
        for one in claim.comparisons
    )


def _interval(one: Comparison) -> str:
    if np.isnan(one.low) and np.isnan(one.high):
        return ""
    return f"{number(one.low)} to {number(one.high)}"


# -- reasons --------------------------------------------------------------------------------------


def reasons(tables: Tables) -> list[str]:
    """The ablations, one after the other."""
    return [
        "### The reward table, reproduced with its defects",
        "",
        "Mean squared error of the reward per step with the paper's settings. The published "
        "protocol logs actions one step late, scores on the training episodes (the GP has seen "
        "four fifths of them), recomputes the reacher's actions with a fifth of the proportional "
        "gain, and subtracts an (N, 1) from an (N,) array for GP and NN, which compares every "
        "episode with every other. Column by column the defects are taken away; a blank means "
        "that the method did not have this one. Median over seeds (least to greatest). The "
        "reacher's goal is fixed here and drawn for every episode in the paper, so that its "
        "figures are not on the same scale.",
        "",
        markdown(reward_table(tables["rewards"])),
        "",
        "The error that the N x N difference reports for a perfect prediction is twice the "
        "variance of the rewards: "
        + "; ".join(
            f"{2 * some['variance'].median():.2g} on {task}"
            for task, some in _first_of_task(tables["rewards"])
        )
        + ".",
        "",
        "### Actions one step late",
        "",
        "The paper's code stores the action a_t beside the state s_t+1 and learns the step from "
        "s_t+1 to s_t+2: the action that causes the step is not an input, but it betrays how the "
        "controller acts, so that a roll-out with recorded actions follows the closed loop and "
        "stays stable, while recomputed actions are inputs that the model never saw. One-step "
        "model D, median error from step 51 to the training length.",
        "",
        markdown(late_table(tables["late"])),
        "",
        "### Unequal budgets",
        "",
        "On the reacher the one-step model gets half the episodes, and a learning rate a "
        "sixteenth of T's. Median error from step 51 to the training length.",
        "",
        markdown(budget_table(tables["budget"])),
        "",
        "### A network that is hardly trained",
        "",
        "The direct network takes some thirty gradient steps in the paper's code. Mean squared "
        "error of the reward on fresh episodes, at the paper's learning rate, then with our "
        "defaults.",
        "",
        markdown(untrained_table(tables["untrained"])),
        "",
    ]


#: What the paper prints in its reward table, by task and line.
PRINTED = {
    ("cartpole", "GP", "none"): 0.884,
    ("cartpole", "NN", "none"): 0.446,
    ("cartpole", "D", "logged"): 0.057,
    ("cartpole", "D", "policy"): 0.979,
    ("cartpole", "T", "none"): 0.010,
    ("reacher", "GP", "none"): 0.127,
    ("reacher", "NN", "none"): 0.074,
    ("reacher", "D", "logged"): 0.485,
    ("reacher", "D", "policy"): 0.072,
    ("reacher", "T", "none"): 0.005,
}


_SOURCE = {"logged": ", recorded", "policy": ", recomputed"}


def reward_table(rewards: pd.DataFrame) -> pd.DataFrame:
    """Line by line the published figure, its protocol, and the defects taken away one by one."""

    def entry(task: str, method: str, actions: str, scored_on: str, column: str = "error") -> str:
        chosen = {"task": task, "method": method, "actions": actions, "scored_on": scored_on}
        some = rewards
        for name, value in chosen.items():
            some = some[some[name] == value]
        return spread(some[column]) if len(some) else ""

    lines = []
    for (task, method, actions), printed in PRINTED.items():
        one_step = method == "D"
        as_published = "D late" if one_step else method
        if one_step and actions == "policy" and task == "reacher":
            as_published = "D late weak"
        late = "D late" if one_step else method
        column = "all_pairs" if method in ("GP", "NN") else "error"
        lines.append(
            {
                "task": task,
                "method": method
                + {"logged": ", logged", "policy": ", recomputed"}.get(actions, ""),
                "the paper prints": f"{printed:g}",
                "its protocol": entry(task, as_published, actions, "train", column),
                "proper difference": ""
                if one_step or method == "T"
                else entry(task, method, actions, "train"),
                "right gains": "" if as_published == late else entry(task, late, actions, "train"),
                "fresh episodes": entry(task, late, actions, "test"),
                "actions aligned": entry(task, method, actions, "test") if one_step else "",
            }
        )
    return pd.DataFrame(lines)


def _first_of_task(rewards: pd.DataFrame) -> Any:
    trained = rewards[(rewards["scored_on"] == "train") & (rewards["method"] == "GP")]
    return trained.groupby("task", sort=False)


def late_table(late: pd.DataFrame) -> pd.DataFrame:
    """Error of D by alignment, source of actions and settings."""
    lines = []
    for (task, settings), some in late.groupby(["task", "settings"], sort=False):
        line: dict[str, Any] = {"task": task, "settings": settings}
        for actions, name in (("logged", "recorded"), ("policy", "recomputed")):
            for alignment in ("late", "aligned"):
                chosen = some[(some["actions"] == actions) & (some["alignment"] == alignment)]
                line[f"{alignment}, {name}"] = spread(chosen["long"])
        lines.append(line)
    return pd.DataFrame(lines)


def budget_table(budget: pd.DataFrame) -> pd.DataFrame:
    """Error by model, number of episodes, training budget and source of actions."""
    titles = {"own": "the paper's", "of T": "T's rate, batch and steps"}
    keys = ["model", "n_train", "budget", "actions"]
    lines = []
    for (model, n_train, how, actions), some in budget.groupby(keys, sort=False):
        line = {"model": model, "training episodes": n_train, "training": titles[str(how)]}
        line |= {"actions": {"policy": "recomputed"}.get(str(actions), actions)}
        lines.append(line | {"error": spread(some["long"])})
    return pd.DataFrame(lines)


def untrained_table(untrained: pd.DataFrame) -> pd.DataFrame:
    """Error by gradient steps."""
    fresh = untrained[untrained["scored_on"] == "test"]
    lines = []
    for steps, some in fresh.groupby("steps", sort=False):
        line: dict[str, Any] = {"gradient steps": steps if steps else "our defaults"}
        for task, of_task in some.groupby("task", sort=False):
            line[str(task)] = spread(of_task["error"])
        lines.append(line)
    return pd.DataFrame(lines)
