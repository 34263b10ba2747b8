"""How long to train the trajectory-based model: error after 1 to 16 epochs.

The paper's T on reacher and cartpole, its error on 100 test episodes averaged over the training
length. Beside it, after the same number of gradient steps, the same model under a one-cycle
schedule, and the library's own T (fresh batches, features of the horizon, mixed draws, one-cycle
schedule). Its batches are larger, so that rows seen are listed as well as steps. (The paper: its
table and its figure of epochs, for one system that it does not name; the size fits the reacher.)
"""

import time
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import ERROR, draw_curve, horizon_axes, legend_below, over_seeds
from benchmarks.paper._rollouts import N_TEST, assess
from benchmarks.paper._tasks import N_EPISODES, TASKS, episodes
from trajlearn import (
    MLPEnsembleRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
    horizon_errors,
    paper,
)
from trajlearn.plotting._style import GREY, line_style, tidy

ORDER = ("reacher", "cartpole")
#: Epochs of the paper's model, and those whose steps the other models are given.
EPOCHS = {
    "full": {"paper": (1, 3, 5, 8, 12, 16), "one-cycle": (1, 3, 8), "default": (1, 3, 8)},
    "quick": {"paper": (1, 3, 5, 8), "one-cycle": (1, 3), "default": (1, 3)},
}
#: The paper's table: average error per step on its test set, where it also chose 8 epochs.
PRINTED = {1: 1.25e-2, 3: 1.15e-2, 5: 1.12e-2, 8: 1.02e-2, 12: 1.07e-2, 16: 1.09e-2}
PRINTED_BEST = min(PRINTED, key=lambda epochs: PRINTED[epochs])
MODELS = {"paper": "T", "one-cycle": "T, one-cycle", "default": "T (ours)"}


def build(settings: str, epochs: int, train: TrajectoryDataset, seed: int) -> Any:
    """T with the paper's settings, those with a one-cycle schedule, or ours; equal steps."""
    own, theirs = MLPEnsembleRegressor(), paper.model("T", random_state=seed)
    if settings == "default":
        n_rows = min(theirs.relabeler.max_rows, theirs.relabeler.n_pairs(train))
        n_steps = epochs * -(-n_rows // theirs.estimator.batch_size)
        return TrajectoryRegressor(random_state=seed).set_params(estimator__max_steps=n_steps)
    theirs.set_params(estimator__max_epochs=epochs)
    if settings == "one-cycle":
        schedule = {"schedule": own.schedule, "learning_rate": own.learning_rate}
        theirs.estimator.set_params(**schedule)
    return theirs


def cell(task: str, settings: str, epochs: int, n_test: int, seed: int) -> dict[str, Any]:
    """Fit one model for some epochs, and assess it within the training length."""
    train, test = episodes(task, seed, n_test=n_test)
    model = build(settings, epochs, train, seed)
    began = time.perf_counter()
    model.fit(train)
    seconds = time.perf_counter() - began
    found = assess(model, test, length=TASKS[task].length)
    learner = model.estimator_
    steps = {"steps": learner.n_steps_, "rows": learner.n_steps_ * learner.batch_size}
    within = np.array(found["windows"]["within"])
    errors = {"mean": within.mean(), "median": np.median(within)}
    # far below the test episodes' own: more training would only fit the training episodes
    errors["train"] = horizon_errors(model.predict(train), train).to_numpy().mean()
    curve = {name: found["curve"][name] for name in ("horizon", "mean", "median")}
    return {"errors": steps | errors | {"fit_seconds": seconds}, "curve": curve}


def run(run: Run) -> Tables:
    """Errors after each number of epochs, and curves by horizon."""
    cells = [
        {
            "task": task,
            "settings": settings,
            "epochs": epochs,
            "n_test": N_TEST[run.mode],
            "seed": seed,
        }
        for task in ORDER
        for settings, after in EPOCHS[run.mode].items()
        for epochs in after
        for seed in run.seeds
    ]
    errors, curves = [], []
    for asked, result in zip(cells, run.cells(cells, cell), strict=True):
        key = {"task": asked["task"], "model": MODELS[asked["settings"]]}
        key |= {name: asked[name] for name in ("epochs", "seed")}
        errors.append(key | result["errors"])
        curves.append(pd.DataFrame(key | result["curve"]))
    return {"errors": pd.DataFrame(errors), "curves": pd.concat(curves, ignore_index=True)}


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "epochs": EPOCHS[mode],
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "lengths": {task: TASKS[task].length for task in ORDER},
    }


def report(tables: Tables) -> str:
    """Errors by epochs, and whether the paper's best number of epochs is the best."""
    lines = [
        f"{ERROR.capitalize()}, averaged over the training length and over test episodes:",
        "mean over seeds (least to greatest). `median` is over test episodes, `train` the mean "
        "over training",
        "episodes. Steps are gradient steps, the same for all models in a line; rows are the "
        "sub-trajectories seen,",
        "repeats included: by T, or by ours in its larger batches. With one seed, the runs of T "
        "with fewer epochs are",
        "the beginnings of those with more.",
        "",
    ]
    for task, some in tables["errors"].groupby("task", sort=False):
        paper_only = some[some["model"] == MODELS["paper"]]
        lines += [f"### {task}", "", markdown(_summary(some)), ""]
        lines += [*_best(paper_only), *_gains(some), ""]
    return "\n".join(lines)


def _summary(errors: pd.DataFrame) -> pd.DataFrame:
    """A line a number of epochs."""
    lines = []
    for epochs, some in errors.groupby("epochs"):
        seen = some.groupby("rows").size().index
        line: dict[str, Any] = {
            "epochs": epochs,
            "steps": some["steps"].iloc[0],
            "rows": " or ".join(f"{n:,}" for n in seen),
            "paper prints": f"{PRINTED[epochs]:.3g}",
        }
        for model in MODELS.values():
            of = some[some["model"] == model]
            line[model] = _spread(of["mean"]) if len(of) else ""
            if model != MODELS["one-cycle"]:
                for name in ("median", "train"):
                    line[f"{model}: {name}"] = f"{of[name].mean():.2g}" if len(of) else ""
        lines.append(line)
    table = pd.DataFrame(lines)
    # the paper names no system; its size fits the reacher
    return table if errors["task"].iloc[0] == "reacher" else table.drop(columns="paper prints")


def _best(errors: pd.DataFrame) -> list[str]:
    """Which number of epochs is best on each seed, and how far the paper's is from it."""
    table = errors.pivot(index="seed", columns="epochs", values="mean")
    medians = errors.pivot(index="seed", columns="epochs", values="median")
    best, most = table.idxmin(axis=1), table.columns.max()
    listed = ", ".join(f"{best[seed]} (seed {seed})" for seed in table.index)
    by_median = ", ".join(map(str, medians.idxmin(axis=1)))
    lines = [f"Best epochs of the paper's T by the mean: {listed}; by the median: {by_median}."]
    if PRINTED_BEST in table and most > PRINTED_BEST:
        more = table[most] / table[PRINTED_BEST] - 1
        over = table[PRINTED_BEST] / table.min(axis=1) - 1
        held = int((best == PRINTED_BEST).sum())
        lines += [
            f"The paper's {PRINTED_BEST} epochs are best on {held} of {len(table)} seeds; their "
            f"error is {_percent(over)} above the best.",
            f"From {PRINTED_BEST} to {most} epochs it changes by {_percent(more)}; in the paper "
            f"by {PRINTED[most] / PRINTED[PRINTED_BEST] - 1:+.0%}.",
        ]
    return lines


def _gains(errors: pd.DataFrame) -> list[str]:
    """What the schedule and the rest of our settings buy with the same steps."""
    table = errors.pivot(index=["epochs", "seed"], columns="model", values="mean")
    lines = []
    others = {"one-cycle": "with a one-cycle schedule", "default": "of ours"}
    for epochs, some in table.groupby("epochs"):
        known = {m: some[MODELS[m]] for m in others if some[MODELS[m]].notna().all()}
        ratios = [
            f"{_spread(some[MODELS['paper']] / of)} times that {others[m]}"
            for m, of in known.items()
        ]
        if ratios:
            lines.append(f"Error of T, epochs {epochs}: {', '.join(ratios)} (same steps).")
    return lines


def _spread(values: pd.Series) -> str:
    """Mean over seeds (least to greatest)."""
    return f"{values.mean():.3g} ({values.min():.2g} to {values.max():.2g})"


def _percent(values: pd.Series) -> str:
    return f"{values.mean():+.0%} ({values.min():+.0%} to {values.max():+.0%})"


def draw(tables: Tables) -> dict[str, Any]:
    """Error against steps above, against the horizon below; a column a task."""
    import matplotlib.pyplot as plt

    errors, curves = tables["errors"], tables["curves"]
    figure, grid = plt.subplots(2, len(ORDER), figsize=(10, 7.6), layout="constrained")
    for (top, bottom), task in zip(grid.T, ORDER):
        _draw_epochs(top, errors[errors["task"] == task], task)
        _draw_horizons(bottom, curves[curves["task"] == task], task)
    grid[0, 0].legend(frameon=False, fontsize=8, loc="upper right", handlelength=3.2, ncols=2)
    legend_below(figure, grid[1, 0], ncols=4)
    return {"epochs": figure}


def _draw_epochs(ax: Any, errors: pd.DataFrame, task: str) -> None:
    """Mean over seeds as a line, seeds as points."""
    for i, model in enumerate(MODELS.values()):
        of, style = errors[errors["model"] == model], line_style(i)
        marker = {"marker": "os^"[i], "mfc": "white", "ms": 5}
        ax.plot(of.groupby("epochs")["mean"].mean(), label=model, lw=1.5, **marker, **style)
        ax.plot(of["epochs"], of["mean"], ls="", marker="os^"[i], ms=3, color=style["color"])
    if task == "reacher":
        printed = {"label": "the paper's table", "color": GREY, "lw": 1, "ls": "dotted"}
        ax.plot(list(PRINTED), list(PRINTED.values()), marker="x", **printed)
    ax.set(xscale="log", yscale="log", xlabel="epochs of the paper's T (gradient steps)")
    ax.set_title(f"{task}: mean over the training length", loc="left", fontsize=10)
    steps = errors.groupby("epochs")["steps"].first()
    ax.set_xticks(steps.index, [f"{e}\n({n / 1e3:.3g}k)" for e, n in steps.items()])
    ax.xaxis.minorticks_off()
    ax.set_ylabel(ERROR)
    tidy(ax)


def _draw_horizons(ax: Any, curves: pd.DataFrame, task: str) -> None:
    """The paper's T after each number of epochs, ours after the most."""
    theirs = curves[curves["model"] == MODELS["paper"]]
    shown = [(some, f"T, epochs: {epochs}") for epochs, some in theirs.groupby("epochs")]
    ours = curves[curves["model"] == MODELS["default"]]
    most = ours["epochs"].max()
    shown.append((ours[ours["epochs"] == most], f"ours, same steps as {most}"))
    for i, (some, label) in enumerate(shown):
        draw_curve(ax, over_seeds(some, ["horizon"], "mean"), i, label, band=None)
    horizon_axes(ax, title=f"{task}: mean over test episodes, median over seeds")


BENCHMARK = Benchmark("epochs", __doc__, run, report, draw, settings, minutes=6)

if __name__ == "__main__":
    BENCHMARK.main()
