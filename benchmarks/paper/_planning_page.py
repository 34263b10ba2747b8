"""The planning results as people read them: text and figures from the tables alone."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._figures import draw_curve, horizon_axes, over_seeds
from benchmarks.paper._planning_trials import PLANNERS
from trajlearn.plotting._style import GREY, INK, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Planners of the paper's figure, from the best (it prints no numbers).
PAPER_ORDER = ["one-step in closed loop", "T in open loop", "one-step in open loop"]
_HOLDS = ["nothing", "planned, hold 1", "planned, hold 25", "planned, hold all", "random gains"]


def report(tables: Tables) -> str:
    """What planners earn and cost, what their model knew of the choice, and what data are worth."""
    flown, faced = tables["trials"], tables["choices"]
    lines = ["### Reward per step and planning time", ""]
    lines += [markdown(_summary(flown)), "", *_notes(flown), ""]
    lines += ["### What the models know of the choice", "", markdown(_known(faced)), ""]
    lines += [*_why(faced), ""]
    lines += ["### Data gathered while theta changes", "", *_data(tables)]
    return "\n".join(lines)


def _ordered(flown: pd.DataFrame) -> list[str]:
    present = set(flown["planner"])
    return [name for name in PLANNERS if name in present]


def _summary(flown: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for name in _ordered(flown):
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
        "decide often share their trials out among the seeds. Times are wall clock on one core, "
        "median over trials. References: the LQR, gains at random, and random shooting on the "
        "simulator itself, held all along. The paper's figure has three bars, best first: "
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
    """Of each model and step: its ranking of 200 gains, and what its favourite is worth."""
    lines = []
    for (planner, model, step), some in faced.groupby(["planner", "model", "step"], sort=False):
        lines.append(
            {
                "trials of": planner,
                "step": step,
                "model": model,
                "rank correlation": f"{some['rank'].median():.2f}",
                "favourite: predicted": f"{some['predicted'].mean():.3f}",
                "favourite: true": f"{some['true'].mean():.3f}",
                "best of the 200": f"{some['best'].mean():.3f}",
                "mean of the 200": f"{some['mean'].mean():.3f}",
                "bad gains": f"{100 * some['low'].mean():.1f} %",
                "bad favourites": f"{100 * some['pick_low'].mean():.0f} %",
            }
        )
    return pd.DataFrame(lines).sort_values(["trials of", "step"], kind="stable")


def _why(faced: pd.DataFrame) -> list[str]:
    """The mechanism, with its numbers."""
    first = faced[faced["step"] == 0]
    numbers = {}
    for model, some in first.groupby("model"):
        numbers[model] = (
            f"{some['predicted'].mean():.3f} predicted, {some['true'].mean():.3f} true, with "
            f"{some['speed_factor'].mean():.2f} and {some['rate_factor'].mean():.2f} times the "
            "LQR's gain on the cart's speed and on the pole's rate"
        )
    told = "; ".join(f"{model}: {text}" for model, text in numbers.items())
    return [
        "At states of the trials, 200 gains at random are held to the end of the trial, in the "
        "model and in the simulator; per step. Bad: worth less than 0.5, which takes a fall. The "
        f"favourite at the first state, on average: {told}.",
        "",
        "The greatest reward lies next to the edge of stability: strong feedback of the cart's "
        "speed with little of the pole's rate brings the cart home fast, or tips the pole over. "
        "Bad gains are rare, and the log has no episode that fell, so T has seen no fall and "
        "its forecast goes on smoothly past the edge; an optimiser finds that error. A one-step "
        "model has seen the states and actions on the way down, under other gains, and its "
        "roll-out falls. Episodes that begin where trials begin and are kept when they fall "
        "(own starts) add few falls. Planning again helps "
        "where it comes before the fall: the pole's state shows what the last gains do. That "
        "theta then changes all the time does no harm by itself: plant and controllers have no "
        "memory, so it does not matter how a state was reached, and near upright the log is "
        "dense.",
    ]


def _data(tables: Tables) -> list[str]:
    rows, errors, trials = tables["rows"], tables["errors"], tables["refits"]
    counts = rows.groupby(["hold", "horizon"], sort=False)["rows"].mean().unstack()
    lines = []
    for hold in (h for h in _HOLDS if h in set(trials["hold"])):
        line: dict[str, Any] = {"added": hold}
        for horizon in (1, 25, 100, 200):
            line[f"rows of {horizon}"] = f"{counts.loc[hold, horizon]:.0f}"
        own = errors[errors["hold"] == hold]
        for low, high in ((1, 25), (50, 200)):
            some = own[own["horizon"].between(low, high)].groupby("seed")["median"].mean()
            line[f"error, {low} to {high}"] = (
                f"{some.median():.2g} ({some.min():.2g} to {some.max():.2g})"
            )
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


def draw(tables: Tables) -> dict[str, Any]:
    """Reward beside time; predicted against true; what data are worth."""
    return {
        "planning": _draw_trials(tables["trials"]),
        "planning-choices": _draw_choices(tables["choices"]),
        "planning-refit": _draw_refits(tables),
    }


def _draw_trials(flown: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    names = _ordered(flown)
    figure, (left, right) = plt.subplots(
        1,
        2,
        figsize=(10, 0.34 * len(names) + 1.4),
        sharey=True,
        layout="constrained",
        width_ratios=(3, 2),
    )
    for i, name in enumerate(names):
        some = flown[flown["planner"] == name]
        shift = np.linspace(-0.22, 0.22, len(some)) if len(some) > 1 else np.zeros(len(some))
        left.plot(some["return"], i + shift, "|", color=GREY, ms=5, alpha=0.6)
        mean, std = some["return"].mean(), some["return"].std()
        left.errorbar(mean, i, xerr=std, fmt="o", color=INK, mfc="white", ms=6, capsize=3, lw=1.3)
        if some["decision_s"].notna().any():
            decision = 1000 * some["decision_s"].median()
            right.plot(decision, i, "o", color=line_style(0)["color"], ms=6)
            right.plot(
                1000 * some["trial_s"].median(),
                i,
                "D",
                color=line_style(1)["color"],
                ms=6,
                mfc="white",
            )
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    left.set_xlim(0, 1.05)
    left.set_xlabel("reward per step (mean ± std; a dash is a trial)")
    right.set_xscale("log")
    right.set_xlabel("planning time (ms, one core)")
    for marker, colour, face, label in (("o", 0, None, "a decision"), ("D", 1, "white", "a trial")):
        right.plot([], [], marker, color=line_style(colour)["color"], mfc=face, label=label)
    right.legend(frameon=False, loc="upper left", bbox_to_anchor=(0, 0.22))
    for ax in (left, right):
        ax.grid(axis="y", color=GREY, alpha=0.2)
        tidy(ax)
    return figure


def _draw_choices(faced: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), sharey=True, layout="constrained")
    for ax, (model, some) in zip(axes, faced.groupby("model", sort=False)):
        for i, (step, at) in enumerate(some.groupby("step")):
            style = line_style(i)
            ax.plot(
                at["predicted"],
                at["true"],
                "os^D"[i % 4],
                color=style["color"],
                ms=5,
                mfc="white",
                label=f"from step {step}",
            )
        ax.plot([0, 1], [0, 1], color=GREY, lw=1)
        ax.set(xlim=(0.5, 1.02), ylim=(0, 1.05))
        ax.set_xlabel("predicted reward per step of the favourite")
        ax.set_title(f"chosen by {model}", loc="left", fontsize=10)
        tidy(ax)
    axes[0].set_ylabel("true reward per step")
    axes[0].legend(frameon=False, loc="upper left")
    return figure


def _draw_refits(tables: Tables) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    errors = tables["errors"]
    present = [hold for hold in _HOLDS if hold in set(errors["hold"])]
    for i, hold in enumerate(present):
        rows = tables["rows"][tables["rows"]["hold"] == hold]
        counts = rows.groupby("horizon")["rows"].mean()
        if hold != "nothing":
            axes[0].plot(
                counts.index,
                counts.clip(lower=0.5),
                marker="os^Dv"[i % 5],
                ms=4,
                mfc="white",
                **line_style(i),
            )
        curve = over_seeds(errors[errors["hold"] == hold], ["horizon"])
        draw_curve(axes[1], curve, i, hold, band=("low", "high"))
        _strip(axes[2], tables["refits"], hold, i)
    axes[0].set(xscale="log", yscale="log", ylim=(0.4, None))
    axes[0].set_xlabel("horizon (steps)")
    axes[0].set_ylabel("rows under constant theta (none: at the bottom)")
    axes[0].set_title("what the added trials hold", loc="left", fontsize=10)
    horizon_axes(axes[1], title="error of new episodes")
    axes[2].set_xticks(
        range(len(present)),
        [name.replace(", ", ",\n").replace(" gains", "\ngains") for name in present],
        fontsize=7,
    )
    axes[2].set_ylim(0, 1.05)
    axes[2].set_ylabel("reward per step")
    axes[2].set_title("next trials", loc="left", fontsize=10)
    for ax in (axes[0], axes[2]):
        tidy(ax)
    figure.legend(
        *axes[1].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=5,
        frameon=False,
        handlelength=3.2,
    )
    return figure


def _strip(ax: "Axes", trials: pd.DataFrame, hold: str, i: int) -> None:
    """Returns of the next trials after some data were added, and their mean."""
    some = trials[(trials["hold"] == hold) & (trials["when"] == "next")]["return"]
    colour = line_style(i)["color"]
    ax.plot(i + np.linspace(-0.2, 0.2, len(some)), some, "_", color=colour, ms=5)
    ax.plot(i, some.mean(), "o", color=INK, mfc="white", ms=6)
