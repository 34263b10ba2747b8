"""The page docs/audit.md: what was measured comes from tables, what the paper says is in text."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._ablations import GP_SHARE, NN_RATE
from benchmarks.paper._claims import SAME, Claim, Comparison, from_tables, number
from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import spread
from benchmarks.paper._reward_models import DIRECT
from benchmarks.paper._reward_page import PAPER

_HEAD = """# An audit of the paper's claims

N. Lambert et al., "Learning Accurate Long-term Dynamics for Model-based Reinforcement Learning"
(CDC 2021), claim by claim: what it says, what was measured here, and a verdict. Every measured
number on this page comes out of `trajlearn reproduce audit`, which reads the stored results of the
other benchmarks and takes the paper's protocol apart in ablations of its own.

**Models.** D, P, DE, PE: one-step models, deterministic or probabilistic (P), single or an ensemble
(E), rolled out with the logged actions or with actions that the controller recomputes from
predicted states. LSTM: the same with a memory. C: a one-step model of the closed loop, without
actions. T, TP, TE, TPE: trajectory models. *Paper's settings*: its networks, learning rates and
epochs. *Tuned*: the library's defaults, or a choice on training episodes, with the same care for
all. In both, actions are aligned (a_t takes s_t to s_t+1). The paper compares with logged actions
and its own settings only; recomputed actions, tuned models and C are what we add.

**Verdicts.** A ratio above 1 speaks for the claim; ∞ means that the other model's error is beyond
all bounds. Where single test episodes are stored, an interval holds the middle 95 % of a bootstrap
over them; otherwise there is the range over training seeds only. A comparison counts for or against
a claim if the interval, where there is one, and every seed agree, and is open otherwise. *Holds*:
all comparisons speak for the claim. *Holds only if*: there are conditions under which all do; they
are named. *Fails*: there are none, and something speaks against it. *Open*: neither.

Not audited here: control, and uncertainty, which has [its own page](uncertainty.md).
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
            "range over seeds": f"{number(min(one.seeds))} to {number(max(one.seeds))}",
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
        "### The reward table, with its defects",
        "",
        "Mean squared error of the reward per step with the paper's settings. The published "
        "protocol logs actions one step late, scores on the training episodes (the GP has seen "
        f"{GP_SHARE:.0%} of them), recomputes the reacher's actions with a fifth of the "
        "proportional gain, trains the direct network for some thirty steps, and subtracts an "
        "(N, 1) from an (N,) array for GP and NN, which compares every episode with every other. "
        "Column by column the defects are taken away; a blank means that the method did not have "
        "this one. Median over seeds (least to greatest).",
        "",
        markdown(reward_table(tables["rewards"])),
        "",
        "The N x N difference reports an error of twice the variance of the rewards for a perfect "
        "prediction: "
        + "; ".join(
            f"{2 * some['variance'].median():.2g} on {task}"
            for task, some in _first_of_task(tables["rewards"])
        )
        + ". What is not reproduced: ranges of gains, feedback on the cosines and a goal for every "
        "episode on the reacher, one-step models that train on longer episodes, and the lengths of "
        "training that text, table and code give differently. Where the second column is far from "
        "the printed figure, these or something unknown matter.",
        "",
        "### Actions one step late",
        "",
        "The paper's code stores the action a_t beside the state s_t+1 and learns the step from "
        "s_t+1 to s_t+2: the action that causes the step is not an input, but it betrays how the "
        "controller acts. Where the plant is unstable (cartpole), a roll-out with late logged "
        "actions follows the closed loop and stays stable, which aligned ones cannot, and "
        "recomputed actions are inputs that the model never saw; the damped reacher hardly cares. "
        "One-step model D, median error from step 51 to the training length.",
        "",
        markdown(late_table(tables["late"])),
        "",
        "### Unequal budgets",
        "",
        "In the paper's code the reacher's one-step model sees half as many episodes, twice as "
        "long, and takes many steps at a low learning rate, where T takes fewer at a high one. "
        "Median error from step 51 to the training length.",
        "",
        markdown(budget_table(tables["budget"])),
        "",
        "### A network that is hardly trained",
        "",
        f"The direct network takes some thirty gradient steps at a rate of {NN_RATE:g} in the "
        "paper's code. Mean squared error of the reward on fresh episodes after more of them, and "
        "with our defaults.",
        "",
        markdown(untrained_table(tables["untrained"])),
        "",
    ]


def reward_table(rewards: pd.DataFrame) -> pd.DataFrame:
    """Line by line the published figure, its protocol, and the defects taken away one by one."""

    def entry(task: str, method: str, actions: str, scored_on: str, column: str = "error") -> str:
        chosen = {"task": task, "method": method, "actions": actions, "scored_on": scored_on}
        some = rewards
        for name, value in chosen.items():
            some = some[some[name] == value]
        return spread(some[column]) if len(some) else ""

    sources = {"logged actions": "logged", "predicted actions": "policy", "": "none"}
    lines = []
    for task, row in [(task, row) for task, rows in PAPER.items() for row in rows]:
        method, _, said = row.partition(", ")
        actions, direct = sources[said], method in DIRECT
        weak = task == "reacher" and actions == "policy"
        late = method if method != "D" else "D late"
        published = "D late weak" if weak else late
        lines.append(
            {
                "task": task,
                "method": row.replace("predicted", "recomputed"),
                "the paper prints": f"{PAPER[task][row][0]:g}",
                "with its defects": entry(
                    task, published, actions, "train", "all_pairs" if direct else "error"
                ),
                "proper difference": entry(task, method, actions, "train") if direct else "",
                "right gains": entry(task, late, actions, "train") if weak else "",
                "fresh episodes": entry(task, late, actions, "test"),
                "actions aligned": entry(task, method, actions, "test") if method == "D" else "",
            }
        )
    return pd.DataFrame(lines)


def _first_of_task(rewards: pd.DataFrame) -> Any:
    trained = rewards[(rewards["scored_on"] == "train") & (rewards["method"] == "GP")]
    return trained.groupby("task", sort=False)


_SETTINGS = {"paper": "paper's", "default": "tuned (our defaults)"}


def late_table(late: pd.DataFrame) -> pd.DataFrame:
    """Error of D by alignment, source of actions and settings."""
    lines = []
    for (task, settings), some in late.groupby(["task", "settings"], sort=False):
        line: dict[str, Any] = {"task": task, "settings": _SETTINGS[str(settings)]}
        for actions, name in (("logged", "logged"), ("policy", "recomputed")):
            for alignment in ("late", "aligned"):
                chosen = some[(some["actions"] == actions) & (some["alignment"] == alignment)]
                line[f"{alignment}, {name}"] = spread(chosen["long"])
        lines.append(line)
    return pd.DataFrame(lines)


def budget_table(budget: pd.DataFrame) -> pd.DataFrame:
    """Error by model, number of episodes, training budget and source of actions."""
    titles = {"own": "the paper's", "of T": "T's rate, batch and steps"}
    keys = ["model", "n_train", "steps", "budget", "actions"]
    lines = []
    for (model, n_train, steps, how, actions), some in budget.groupby(keys, sort=False):
        line = {"model": model, "training episodes": n_train, "steps of each": steps}
        line["training"] = titles[str(how)]
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
