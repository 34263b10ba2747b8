"""Text of the results of one system: errors, the selector's distance to the best, costs."""

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.regimes import _floor
from benchmarks.regimes._members import RULES
from benchmarks.regimes._regimes import FRESH, POLICIES
from benchmarks.regimes._tables import EXACT, in_order

#: Goals that were set before the library's own forecasters were built: cumulated error, and
#: reward error, of cartpole.
GOALS = {
    ("clean", "known"): (1e-6, 2e-5),
    ("noise 1 %", "known"): (2e-5, 3e-4),
    ("noise 3 %", "known"): (5e-5, 2e-3),
    ("noise 10 %", "known"): (2e-4, 0.013),
    ("20 episodes, noise 3 %", "known"): (2e-4, 0.015),
    ("noise 3 %", "unknown"): (1.2e-4, 0.005),
    ("positions only", "unknown"): (5e-4, 0.03),
}


def report(system: str, tables: Tables) -> str:
    """The whole text of one system."""
    scores = tables[f"{system}-scores"]
    seeds = judged_seeds(scores)
    floors = tables.get(f"{system}-floors")
    if floors is not None:
        floors = (
            floors[floors["seed"].isin(seeds)]
            .groupby("regime")[["cum", "typical", "reward"]]
            .median()
        )
    lines = [
        f"## {system}",
        "",
        f"Seeds {', '.join(map(str, seeds))}"
        + (" (fresh: nothing was chosen on them)." if set(seeds) <= set(FRESH) else ".")
        + " Errors are squared, in ranges of the training states, against the true test states "
        "(real flights: the logged ones); cumulated: mean over test episodes and horizons, which "
        "one or two episodes at the edge of stability may decide; typical: median over episodes, "
        "averaged over horizons. "
        "Median over seeds (least to greatest). A model that diverges has an infinite error; "
        "a blank was not run. Peers may have been run on fewer seeds, see below.",
        "",
    ]
    for policy in POLICIES:
        some = scores[(scores["policy"] == policy) & scores["seed"].isin(seeds)]
        if some.empty:
            continue
        known = floors if policy == "known" else None
        lines += [f"### Policy {policy}: cumulated error", ""]
        lines += [markdown(wide(system, some, "cum", known)), ""]
        lines += [f"### Policy {policy}: typical error", ""]
        lines += [markdown(wide(system, some, "typical", known)), ""]
        if some["reward"].notna().any():
            lines += [f"### Policy {policy}: squared error of the mean reward", ""]
            lines += [markdown(wide(system, some, "reward", known)), ""]
    if floors is not None:
        lines += [
            f"{_floor.NAME}: the simulator itself, without its process noise, under the known "
            "policy, from the mean of where an episode may have started given the noisy "
            "measurement. No model of the step can be expected to do better.",
            "",
        ]
    if system == "cartpole":
        some = scores[scores["seed"].isin(seeds)]
        lines += ["### Goals", "", markdown(goals(some, floors)), ""]
    ratios = tables.get(f"{system}-ratios")
    if ratios is not None:
        lines += [
            "### The selector and the best single model",
            "",
            "Ratio of errors at every stored horizon. The best single model (member or peer) of a "
            "horizon is found on one half of the test episodes, and both are judged on the "
            f"other, and the other way round. Errors below {EXACT:g} count as equal. Of each "
            "regime and seed the median and the worst horizon; then the median and the greatest "
            "of these.",
            "",
            markdown(distribution(ratios)),
            "",
        ]
    fits = tables.get(f"{system}-fits")
    if fits is not None:
        lines += ["### Costs, and the noise that was found", "", markdown(costs(fits)), ""]
        lines += [
            "CPU seconds of five fits (four folds and all episodes; with five episodes, six), "
            "median over regimes and seeds. Noise: share of the fits on noisy, noise-free and real "
            "states in which measurement noise was found, and its estimate over the truth.",
            "",
        ]
    peers = tables.get(f"{system}-peers")
    if peers is not None:
        lines += ["### Peers", "", markdown(peer_lines(peers)), ""]
    return "\n".join(lines)


def judged_seeds(scores: pd.DataFrame) -> list[int]:
    """The fresh seeds that were run, or else those of development."""
    run = [int(seed) for seed in scores["seed"].unique()]
    fresh = [seed for seed in run if seed in FRESH]
    return sorted(fresh or run)


def on_all_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """Lines of the models that were run on every seed of their regime: others had easier ones."""
    regime = ["regime", "policy"]
    n_seeds = scores.groupby(regime)["seed"].transform("nunique")
    return scores[scores.groupby([*regime, "model"])["seed"].transform("nunique") == n_seeds]


def wide(
    system: str, scores: pd.DataFrame, column: str, floors: pd.DataFrame | None
) -> pd.DataFrame:
    """A line a regime, a column a model: median over seeds; the spread of the pick."""
    table = scores.pivot_table(column, "regime", "model", aggfunc="median", sort=False)
    table = table.loc[in_order(system, table.index)]
    pick = scores[scores["model"] == "pick"].groupby("regime")[column]
    spread = [
        f"{low:.1g} to {high:.1g}"
        for low, high in zip(pick.min().loc[table.index], pick.max().loc[table.index])
    ]
    table.insert(list(table.columns).index("pick") + 1, "pick, spread", spread)
    if floors is not None:
        table[_floor.NAME] = floors[column].reindex(table.index)
    return table.reset_index()


def goals(scores: pd.DataFrame, floors: pd.DataFrame | None) -> pd.DataFrame:
    """What was to be reached, beside the pick, the best single model and the plant itself."""
    lines = []
    for (regime, policy), (cum, reward) in GOALS.items():
        some = scores[(scores["regime"] == regime) & (scores["policy"] == policy)]
        if some.empty:
            continue
        over = on_all_seeds(some).groupby("model")[["cum", "reward"]].median()
        best = over.drop(index=list(RULES), errors="ignore")["cum"].idxmin()
        line = {"regime": regime, "policy": policy}
        line |= {"goal": f"{cum:.1g} / {reward:.1g}"}
        line |= {rule: _pair(over.loc[rule]) for rule in RULES if rule in over.index}
        line["best single"] = f"{best}: {_pair(over.loc[best])}"
        if floors is not None and regime in floors.index and policy == "known":
            line[_floor.NAME] = _pair(floors.loc[regime])
        lines.append(line)
    return pd.DataFrame(lines).replace({np.nan: None})


def _pair(line: "pd.Series[float]") -> str:
    return f"{line['cum']:.2g} / {line['reward']:.2g}"


def distribution(ratios: pd.DataFrame) -> pd.DataFrame:
    """Ratios over all regimes, apart for fresh seeds and those that rules were chosen on."""
    lines = []
    fresh = ratios["seed"].isin(FRESH)
    kinds = {"fresh": fresh, "others": ~fresh}
    for rule in RULES:
        for statistic in ("median", "mean"):
            for policy in POLICIES:
                for kind, of_kind in kinds.items():
                    some = ratios[
                        (ratios["rule"] == rule)
                        & (ratios["statistic"] == statistic)
                        & (ratios["policy"] == policy)
                        & of_kind
                    ]
                    if some.empty:
                        continue
                    lines.append(
                        {
                            "rule": rule,
                            "error": f"{statistic} over episodes",
                            "policy": policy,
                            "seeds": kind,
                            "n": str(len(some)),
                            "median horizon: median": some["middle"].median(),
                            "greatest": some["middle"].max(),
                            "worst horizon: median": some["worst"].median(),
                            "greatest ": some["worst"].max(),
                        }
                    )
    return pd.DataFrame(lines)


def costs(fits: pd.DataFrame) -> pd.DataFrame:
    """Seconds of each member; how often noise was found, and how well it was estimated."""
    lines = []
    for member, some in fits.groupby("member", sort=False):
        line = {"member": member, "seconds": some["seconds"].median()}
        if "found" in some and some["found"].notna().any():
            noisy, found = some["true"] > 0, some["found"].astype(float)
            line["found, noisy"] = found[noisy].mean()
            line["found, noise-free"] = found[some["true"] == 0].mean()
            line["found, unknown"] = found[some["true"].isna()].mean()
            hit = some.loc[noisy & (found > 0), "std/true"]
            line["estimate / true"] = (
                f"{hit.median():.2f} ({hit.min():.2f} to {hit.max():.2f})" if len(hit) else ""
            )
        lines.append(line)
    return pd.DataFrame(lines).replace({np.nan: None})


def peer_lines(peers: pd.DataFrame) -> pd.DataFrame:
    """Settings chosen most often, seconds, and failures of each peer."""
    lines = []
    for peer, some in peers.groupby("peer", sort=False):
        seeds = ", ".join(map(str, sorted(some["seed"].unique())))
        line = {"peer": peer, "seeds": seeds, "cells": str(len(some))}
        settings = some["settings"].dropna() if "settings" in some else pd.Series(dtype=str)
        settings = settings[settings != ""]
        line["chosen most often"] = settings.mode().iloc[0] if len(settings) else ""
        for name in ("tuning", "fit"):
            line[f"{name}, s"] = some[name].median() if name in some else np.nan
        failed = some["failure"].dropna() if "failure" in some else []
        line["failed"] = f"{len(failed)}: {failed.iloc[0]}" if len(failed) else "0"
        lines.append(line)
    return pd.DataFrame(lines)
