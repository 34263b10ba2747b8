"""Trained on stable, unstable or periodic cartpole, tested on all three.

T and the deterministic one-step model D (the one the paper's caption names), with the paper's
settings and with ours; every model is fitted on one kind of data and tested on each. The paper:
T generalises from unstable and periodic data; one-step models diverge rapidly, except trained
and tested on unstable data.

Which unstable episodes? Their gains push the pole over, and three things can be done then.
"unstable": no limits, so that no episode ends and none is selected; the pole tumbles and the
cart runs off for all 200 steps. The paper's code comes to the same: it doubles the limits at
every draw and never restores them. "survivors": draw until an episode stays within the limits
(24 degrees, 9.6 m); these are the few episodes that happen to be stable, a biased selection.
"ended": the honest log of the same draws, each episode up to where it leaves the limits, kept
however short; a median is then over the episodes that reach the horizon. Stable and periodic
episodes are drawn until they survive, as in the paper.

Errors of all models on a test set share a scale: the range of that kind's training episodes.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import draw_curve, horizon_axes, legend_below, over_seeds, share_y
from benchmarks.paper._intervals import spread
from benchmarks.paper._kinds import (
    HORIZONS,
    KINDS,
    LENGTH,
    WINDOWS,
    assess,
    environment,
    episodes,
    errors_of,
    errors_of_holding,
    example,
    facts,
    state_range,
)
from benchmarks.paper._models import build, label
from benchmarks.paper._rollouts import N_TEST, action_sources
from benchmarks.paper._tasks import N_EPISODES
from trajlearn.plotting._style import GREY, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MODELS = [("D", "paper"), ("T", "paper"), ("D", "default"), ("T", "default")]
#: Ways to keep unstable episodes, with the window of horizons that their tables are over.
WAYS = {
    "unstable": ("long", "Unstable episodes without limits, as in the paper"),
    "survivors": ("long", "Unstable episodes that survive: drawn until one stays in the limits"),
    "ended": ("short", "Unstable episodes up to where they leave the limits"),
}
#: The curves of a panel: model and actions, and how the legend writes them.
CURVES = {
    ("D", "logged"): "one-step D, logged actions (paper)",
    ("T", "none"): "T (paper)",
    ("D (ours)", "policy"): "one-step D, recomputed actions (ours)",
    ("T (ours)", "none"): "T (ours)",
}
HELD = "start state held"
#: Test episodes of every seed that must reach a horizon for a median to be drawn.
MIN_EPISODES = 5
# horizons in the table of the data
_REACH = (1, 2, 5, 10, 20, 50, 200)


def cell(
    trained: str, model: str, settings: str, mode: str, seed: int, n_train: int, n_test: int
) -> list[dict[str, Any]]:
    """Fit one model on one kind of data, and assess it on all."""
    data = {kind: episodes(kind, seed, n_train, n_test) for kind in KINDS}
    estimator = build(model, settings, policy=environment(trained).policy, mode=mode, seed=seed)
    estimator.fit(data[trained][0])
    results = []
    for tested, (train, test) in data.items():
        for actions in action_sources(model):
            asked = {} if actions == "none" else {"actions": actions}
            errors = errors_of(estimator, test, state_range(train), **asked)
            results.append({"tested": tested, "actions": actions} | assess(errors))
    return results


def run(run: Run) -> Tables:
    """Errors of every model on every kind of data, and what the data are like."""
    sizes = {"n_train": N_EPISODES, "n_test": N_TEST[run.mode]}
    cells = [
        {"trained": kind, "model": model, "settings": how, "mode": run.mode, "seed": seed} | sizes
        for kind in KINDS
        for model, how in MODELS
        for seed in run.seeds
    ]
    found: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for asked, results in zip(cells, run.cells(cells, cell), strict=True):
        model = label(asked["model"], asked["settings"])
        for some in results:
            key = {"trained": asked["trained"], "tested": some["tested"], "model": model}
            found.append((key | {"actions": some["actions"], "seed": asked["seed"]}, some))
    data, examples = [], []
    for kind in KINDS:
        for seed in run.seeds:
            train, test = episodes(kind, seed, **sizes)
            key = {"trained": "-", "tested": kind, "model": HELD, "actions": "none", "seed": seed}
            found.append((key, assess(errors_of_holding(test, state_range(train)))))
            data.append({"kind": kind, "seed": seed} | facts(train, test))
            if seed == run.seeds[0]:
                examples.append(example(test).assign(kind=kind))
    drawn = [{**key, **some["curve"]} for key, some in found if _drawn(key)]
    return {
        "curves": pd.concat([pd.DataFrame(curve) for curve in drawn], ignore_index=True),
        "pairs": pd.DataFrame([key | some["windows"] for key, some in found]),
        "data": pd.DataFrame(data),
        "examples": pd.concat(examples, ignore_index=True),
    }


def _drawn(key: dict[str, Any]) -> bool:
    return key["model"] == HELD or (key["model"], key["actions"]) in CURVES


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "models": MODELS,
        "kinds": {kind: {k: str(v) for k, v in how.items()} for kind, how in KINDS.items()},
        "scale": "range of the training episodes of the tested kind",
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "length": LENGTH,
    }


# -- text ---------------------------------------------------------------------------------


def report(tables: Tables) -> str:
    """Errors and ratios of every pair of kinds, and what the data are like."""
    pairs = tables["pairs"]
    lines = [
        "Squared error (range of the tested kind's training episodes = 1): mean over a window of "
        "horizons, median over test episodes, median over seeds (least to greatest). Episodes "
        "that diverge are counted over all seeds. A ratio above 1: one-step is worse than T.",
        "",
    ]
    for way, (window, title) in WAYS.items():
        lines += [f"### {title}", "", _counted(pairs, way, window), ""]
        for suffix, how in (("", "The paper's settings"), (" (ours)", "Our settings")):
            table = ratios(pairs, kinds(way), suffix, window)
            if way != "unstable":
                # the others stand in the first section
                table = table[(table[["trained on", "tested on"]] == way).any(axis=1)]
            lines += [f"{how}, horizons {_horizons(window)}:", "", markdown(table), ""]
            lines += [count_worse(pairs, kinds(way), suffix, window), ""]
    lines += ["### The data", "", markdown(_data(tables)), ""]
    lines += [
        "Ranges of the training episodes in m, m/s, rad and rad/s. Swinging: share of test "
        "episodes whose angle changes sides at least three times by more than 0.01 rad. Last "
        "columns: test episodes of all seeds that reach a horizon. Median over seeds.",
    ]
    return "\n".join(lines)


def kinds(way: str) -> list[str]:
    """The three kinds of the paper's grid, with one way to keep unstable episodes."""
    return ["stable", way, "periodic"]


def _horizons(window: str) -> str:
    where = WINDOWS[window]
    return f"{where.start + 1} to {where.stop}"


def _counted(pairs: pd.DataFrame, kind: str, window: str) -> str:
    held = pairs[(pairs["model"] == HELD) & (pairs["tested"] == kind)]
    n, of = held[[f"n_{window}", "n_episodes"]].sum()
    steps = _horizons(window)
    return f"Of {of} {kind} test episodes, {n} have steps at horizons {steps}; these count."


def ratios(pairs: pd.DataFrame, kinds: list[str], suffix: str, window: str) -> pd.DataFrame:
    """One-step models, T and their ratios, a line a pair of kinds."""
    keys = ["trained", "tested", "model", "actions", "seed"]
    by_key = pairs.set_index(keys).sort_index()
    lines = []
    for trained in kinds:
        for tested in kinds:
            here = by_key.loc[trained, tested]
            logged, policy = (here.loc[f"D{suffix}", how] for how in ("logged", "policy"))
            trajectory = here.loc[f"T{suffix}", "none"]
            line = {"trained on": trained, "tested on": tested}
            line["D, logged"] = _entry(logged, window)
            line["D, recomputed"] = _entry(policy, window)
            line["T"] = _entry(trajectory, window)
            line[HELD] = spread(by_key.loc["-", tested, HELD, "none"][window])
            line["D, logged / T"] = spread(logged[window] / trajectory[window])
            line["D, recomputed / T"] = spread(policy[window] / trajectory[window])
            lines.append(line)
    return pd.DataFrame(lines)


def _entry(seeds: pd.DataFrame, window: str) -> str:
    """An error with its spread over seeds, and how many episodes diverge."""
    diverged, of = int(seeds["n_diverged"].sum()), int(seeds["n_episodes"].sum())
    return spread(seeds[window]) + (f"; {diverged} of {of} diverge" if diverged else "")


def count_worse(pairs: pd.DataFrame, kinds: list[str], suffix: str, window: str) -> str:
    """In how many pairs D is worse than T, and either worse than holding the start state."""
    keys = ["model", "actions", "trained", "tested"]
    errors = pairs.groupby(keys)[window].median()
    grid = [(trained, tested) for trained in kinds for tested in kinds]

    def of(model: str, actions: str) -> pd.Series:
        return errors[model, actions].loc[grid]

    still = errors[HELD, "none", "-"].loc[[tested for _, tested in grid]].to_numpy()
    t = of(f"T{suffix}", "none")
    logged, policy = (of(f"D{suffix}", how) for how in ("logged", "policy"))
    return (
        f"Of all {len(grid)} pairs, D with logged actions is worse than T in "
        f"{(logged > t).sum()}, with recomputed actions in {(policy > t).sum()}. Worse than "
        f"holding the start state: D, logged, in {(logged > still).sum()}; D, recomputed, in "
        f"{(policy > still).sum()}; T in {(t > still).sum()}."
    )


def reach(tables: Tables) -> pd.DataFrame:
    """Test episodes that reach each horizon (index), of all seeds, by kind (columns)."""
    held = tables["curves"][tables["curves"]["model"] == HELD]
    counts = held.pivot_table("n_episodes", "horizon", "tested", aggfunc="sum", sort=False)
    return counts.reindex(HORIZONS).fillna(0).astype(int)


def _data(tables: Tables) -> pd.DataFrame:
    lines = []
    counts = reach(tables)
    for kind, some in tables["data"].groupby("kind", sort=False):
        medians = some.drop(columns=["kind", "seed"]).median()
        line = {"kind": kind, "training steps": str(int(medians["training_steps"]))}
        line |= {k.replace("_", " ", 1): v for k, v in medians.iloc[1:].items()}
        lines.append(
            line | {f"reach {h}": str(counts[kind][h]) for h in (1, 2, 5, 10, 20, 50, 200)}
        )
    return pd.DataFrame(lines)


# -- figures ------------------------------------------------------------------------------


def draw(tables: Tables) -> "dict[str, Figure]":
    """The paper's grid for every way to keep unstable episodes, and how long episodes last."""
    grids = {f"data-types-{way}": _grid(tables, kinds(way)) for way in WAYS}
    return grids | {"data-types-reach": _draw_reach(reach(tables))}


def _grid(tables: Tables, kinds: list[str]) -> "Figure":
    """An example of each kind, and below a panel a pair: column trained on, row tested on."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        4, 3, figsize=(10.5, 11.5), layout="constrained", height_ratios=[0.7, 1, 1, 1]
    )
    for ax, kind in zip(axes[0], kinds, strict=True):
        some = tables["examples"][tables["examples"]["kind"] == kind]
        for i, (name, unit) in enumerate({"x": "m", "theta": "rad"}.items()):
            text = f"{name} ({unit})"
            ax.plot(some["step"], some[name], lw=1.5, label=text, **line_style(i))
        ax.axhline(0, color=GREY, lw=0.8)
        ax.set_title(f"an episode: {kind}", loc="left", fontsize=10)
        ax.set_xlabel("step")
        tidy(ax)
    axes[0, 0].legend(frameon=False, fontsize=8)
    curves = _reached(tables["curves"])
    for row, tested in zip(axes[1:], kinds, strict=True):
        some = curves[curves["tested"] == tested]
        for ax, trained in zip(row, kinds, strict=True):
            _panel(ax, some[some["trained"].isin([trained, "-"])])
            horizon_axes(ax, title=f"trained on {trained}, tested on {tested}")
            ax.set_xlim(0, some["horizon"].max())
            ax.set_ylabel("")
        row[0].set_ylabel(f"squared error\n(range of {tested} data = 1)")
    share_y(axes[1:].ravel())
    legend_below(figure, axes[1, 0], ncols=3)
    return figure


def _panel(ax: "Axes", curves: pd.DataFrame) -> None:
    still = over_seeds(curves[curves["model"] == HELD], ["horizon"])
    ax.plot(still["horizon"], still["middle"], color=GREY, lw=1, label=HELD)
    for i, ((model, actions), name) in enumerate(CURVES.items()):
        chosen = curves[(curves["model"] == model) & (curves["actions"] == actions)]
        draw_curve(ax, over_seeds(chosen, ["horizon"]), i, name, band=("low", "high"))


def _reached(curves: pd.DataFrame) -> pd.DataFrame:
    """Only horizons that enough test episodes of every seed reach."""
    least = curves.groupby(["tested", "horizon"])["n_episodes"].transform("min")
    return curves[least >= MIN_EPISODES]


def _draw_reach(counts: pd.DataFrame) -> "Figure":
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    # kinds of which the same episodes remain share a line
    same = counts.T.groupby(counts.T.apply(tuple, axis=1), sort=False).groups
    for i, (numbers, names) in enumerate(same.items()):
        style = line_style(i)
        marks = {"marker": "os^Dv"[i], "ms": 4, "mfc": "white"}
        ax.plot(counts.index, np.array(numbers), lw=1.5, label=", ".join(names), **marks, **style)
    ax.set_ylim(0, 1.08 * counts.to_numpy().max())
    ax.set_xlabel("horizon (steps)")
    ax.set_ylabel("test episodes (all seeds)")
    ax.set_title("Test episodes that reach a horizon", loc="left", fontsize=10)
    ax.legend(frameon=False, handlelength=3.2)
    tidy(ax)
    return figure


BENCHMARK = Benchmark("data-types", __doc__, run, report, draw, settings, minutes=6)

if __name__ == "__main__":
    BENCHMARK.main()
