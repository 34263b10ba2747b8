"""The paper's claims one by one: what it says, what was measured, and a verdict.

Runs the ablations of the paper's protocol (late actions, scoring on training episodes, an N x N
difference, an untrained network, unequal budgets), and reads the stored results of the other
benchmarks of this folder: run those first. Writes docs/audit.md from a full run.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks._results import read_json
from benchmarks.paper._ablations import (
    GP_SHARE,
    NN_STEPS,
    all_pairs_error,
    budget_cell,
    late_cell,
    plan,
    planning_cell,
    reward_cell,
    untrained_cell,
)
from benchmarks.paper._audit_claims import claims
from benchmarks.paper._audit_page import page
from benchmarks.paper._claims import Sources, from_tables, to_tables
from benchmarks.paper._command import Benchmark, Run, Tables, read_tables
from benchmarks.paper._rollouts import N_TEST
from benchmarks.paper._tasks import N_EPISODES, TASKS
from trajlearn.plotting._style import GREY, tidy

DOCS = Path(__file__).parents[2] / "docs" / "audit.md"
#: Benchmarks whose stored tables the audit reads.
SOURCES = (
    "horizon-error",
    "action-source",
    "all-models",
    "data-types",
    "sample-efficiency",
    "continuous-time",
    "reward-table",
)


def run(run: Run) -> Tables:
    """Tables of the ablations, and the claims as the stored results judge them."""
    results = {}
    for function, cells in plan(run.mode, run.seeds).items():
        # nothing may run beside what is timed
        by = replace(run, n_jobs=1) if function is planning_cell else run
        results[function] = list(zip(cells, by.cells(cells, function), strict=True))
    ablations = {
        "rewards": _rewards(results[reward_cell]),
        "late": _medians(results[late_cell]).assign(alignment="late"),
        "budget": _medians(results[budget_cell]),
        "untrained": _rewards(results[untrained_cell]),
        "planning": pd.DataFrame(
            {"candidates": asked["candidates"], "seed": asked["seed"], "way": way, "seconds": taken}
            for asked, result in results[planning_cell]
            for way, taken in result.items()
        ),
    }
    sources = stored(run.root)
    aligned = _aligned(sources["horizon-error"]["episodes"])
    ablations["late"] = pd.concat([ablations["late"], aligned], ignore_index=True)
    judged = claims(sources | {"audit": ablations})
    return to_tables(judged) | ablations | {"sources": _provenance(run)}


def stored(root: Path) -> Sources:
    """Tables of the other benchmarks in a folder of results."""
    sources: Sources = {}
    for benchmark, result in _results():
        sources.setdefault(benchmark, {}).update(read_tables(root / benchmark, result))
    return sources


def _aligned(episodes: pd.DataFrame) -> pd.DataFrame:
    """Medians of the same models with aligned actions, from the benchmark that has them."""
    settings = {"D": "paper", "D (ours)": "default"}
    some = episodes[episodes["model"].isin(settings)]
    some = some.assign(settings=some["model"].map(settings), alignment="aligned")
    keys = ["task", "settings", "actions", "seed", "alignment"]
    return some.groupby(keys, sort=False)[["short", "long", "beyond"]].median().reset_index()


def _results() -> list[tuple[str, str]]:
    """Benchmarks that are read, each with the names of its results."""
    tasks = {"reward-table": list(TASKS)}
    return [(name, result) for name in SOURCES for result in tasks.get(name, [name])]


def _provenance(run: Run) -> pd.DataFrame:
    """What the results of the other benchmarks are."""
    lines = []
    for name, result in _results():
        facts = read_json(run.root / name / f"{result}.json")
        line = {"benchmark": name if name == result else f"{name}, {result}"}
        line |= {"mode": facts["mode"], "seeds": len(facts["seeds"]), "commit": facts["commit"]}
        lines.append(line)
    return pd.DataFrame(lines)


_Cells = list[tuple[dict[str, Any], Any]]


def _rewards(results: _Cells) -> pd.DataFrame:
    """A line a fit and set of episodes: the squared error, and that of all pairs."""
    lines = []
    for asked, result in results:
        for name, some in result.items():
            estimate, truth = (np.asarray(some[key], float) for key in ("estimate", "truth"))
            scored_on, _, actions = name.partition(", ")
            line = {key: value for key, value in asked.items() if key != "mode"}
            line |= {"scored_on": scored_on, "actions": actions or "none"}
            line["error"] = float(np.mean((estimate - truth) ** 2))
            line["all_pairs"] = all_pairs_error(estimate, truth)
            lines.append(line | {"variance": float(truth.var())})
    return pd.DataFrame(lines)


def _medians(results: _Cells) -> pd.DataFrame:
    """A line a fit and source of actions: the median over episodes in each window."""
    lines = []
    for asked, result in results:
        for actions, windows in result.items():
            line = {key: value for key, value in asked.items() if key != "mode"}
            medians = {name: float(np.median(errors)) for name, errors in windows.items()}
            lines.append(line | {"actions": actions} | medians)
    return pd.DataFrame(lines)


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "tasks": TASKS,
        "gp_share": GP_SHARE,
        "nn_steps": NN_STEPS[mode],
    }


def draw(tables: Tables) -> dict[str, Any]:
    """All comparisons at a glance: ratios by claim, on a logarithmic axis."""
    import matplotlib.pyplot as plt

    judged = from_tables(tables)
    figure, ax = plt.subplots(figsize=(11.0, 0.9 + 0.42 * len(judged)), layout="constrained")
    looks = {"for": ("o", "#0072B2"), "against": ("X", "#D55E00"), "open": ("s", GREY)}
    for row, claim in enumerate(judged):
        for verdict, (marker, colour) in looks.items():
            some = [one.estimate for one in claim.comparisons if one.verdict == verdict]
            at = row + {"for": -0.18, "against": 0.18, "open": 0.0}[verdict]
            shown = np.clip(some, *_SHOWN)
            label = f"speaks {verdict}" if verdict != "open" else "open"
            ax.plot(
                shown,
                np.full(len(some), at),
                marker,
                ms=5,
                mec=colour,
                mfc="none" if verdict == "against" else colour,
                label=label if row == 0 else None,
            )
    ax.axvline(1.0, color=GREY, lw=1, ls="dotted")
    ax.set_xscale("log")
    ax.set_xlim(_SHOWN[0] / 2, _SHOWN[1] * 2)
    ax.set_yticks(range(len(judged)), [f"{i}. {c.title}" for i, c in enumerate(judged, 1)])
    ax.invert_yaxis()
    ax.set_xlabel("ratio; above 1 it speaks for the claim (ends of the axis: beyond)")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    tidy(ax)
    return {"audit": figure}


# ratios drawn; further ones lie at the ends
_SHOWN = (1e-4, 1e4)

BENCHMARK = Benchmark("audit", __doc__, run, page, draw, settings, minutes=15, publish=DOCS)

if __name__ == "__main__":
    BENCHMARK.main()
