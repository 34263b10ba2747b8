"""Predicted states of one test episode a task, every dimension over its truth.

D and PE with logged and with recomputed actions and T, with the paper's settings, and T with ours,
on cartpole (4 states) and reacher (15). The episode is not picked for its looks: it is the one
whose error, with the paper's T, is the median of the test episodes (the lower of the two in the
middle). Seeds choose their own; the figures show the first. (The paper: its figures of the states
of reacher and of cartpole.)
"""

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import draw_curve, legend_below
from benchmarks.paper._intervals import spread
from benchmarks.paper._models import build, label
from benchmarks.paper._rollouts import N_TEST, action_sources, measure
from benchmarks.paper._tasks import N_EPISODES, TASKS, environment, episodes
from benchmarks.paper.horizon_error import ACTIONS, named_models
from trajlearn.exceptions import DivergenceWarning
from trajlearn.plotting._style import GREY, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MODELS = [("D", "paper"), ("PE", "paper"), ("T", "paper"), ("T", "default")]
# lines of the figures, and their style
DRAWN = {"D, logged": 0, "D, recomputed": 5, "PE, recomputed": 1, "T": 3, "T (ours)": 4}
COLUMNS = {"cartpole": 2, "reacher": 3}
UNITS = {"x": "m", "x_dot": "m/s", "theta": "rad", "theta_dot": "rad/s"}
UNITS |= {"cos": "", "sin": "", "velocity": "rad/s"}
# broad and pale, so that a prediction on top does not hide it
TRUTH: dict[str, Any] = {"color": GREY, "lw": 5, "alpha": 0.4, "label": "truth"}
# squared error in training ranges beyond which a prediction that stays there has diverged
DIVERGED = 1.0


def run(run: Run) -> Tables:
    """Predicted states, and the error of every state dimension."""
    chosen = median_episodes(measure(run, list(TASKS), [("T", "paper")])["episodes"])
    cells = [
        {"task": task, "model": model, "settings": settings, "mode": run.mode}
        | {"seed": seed, "episode": episode}
        for (task, seed), episode in chosen.items()
        for model, settings in MODELS
    ]
    states: dict[tuple[str, int], pd.DataFrame] = {}
    errors = []
    for asked, result in zip(cells, run.cells(cells, cell), strict=True):
        key = {name: asked[name] for name in ("task", "seed", "episode")}
        name = label(asked["model"], asked["settings"])
        index = pd.MultiIndex.from_product(
            [result["horizon"], result["names"]], names=["horizon", "state"]
        )
        table = states.setdefault(
            (asked["task"], asked["seed"]),
            pd.DataFrame({**key, "truth": np.ravel(result["truth"])}, index),
        )
        for actions, some in result["actions"].items():
            table[name + ACTIONS[actions]] = np.ravel(some["states"])
            line = key | {"model": name, "actions": actions, "state": result["names"]}
            line |= {"error": some["error"], "diverges_at": some["diverges_at"]}
            errors.append(pd.DataFrame(line))
    together = pd.concat([table.reset_index() for table in states.values()], ignore_index=True)
    return {"states": together, "errors": pd.concat(errors, ignore_index=True)}


def median_episodes(errors: pd.DataFrame) -> dict[tuple[str, int], int]:
    """For every task and seed, the episode with the median error over the training length.

    Parameters
    ----------
    errors : DataFrame
        Of one model, as from `measure`.
    """
    chosen = {}
    for (task, seed), some in errors.groupby(["task", "seed"], sort=False):
        ordered = some.sort_values("within", kind="stable")["episode"].to_numpy()
        chosen[str(task), int(seed)] = int(ordered[(len(ordered) - 1) // 2])
    return chosen


def cell(
    task: str, model: str, settings: str, mode: str, seed: int, episode: int
) -> dict[str, Any]:
    """Fit one model on one seed, and predict one test episode with every source of actions."""
    env, (length, test_length) = environment(task), TASKS[task]
    train, test = episodes(task, seed, n_test=N_TEST[mode], test_length=test_length)
    estimator = build(model, settings, policy=env.policy, mode=mode, seed=seed).fit(train)
    one = test[[episode]].truncate(length)
    steps = stored_steps(length)
    results = {}
    for actions in action_sources(model):
        asked = {} if actions == "none" else {"actions": actions}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DivergenceWarning)
            forecast = estimator.predict(one, **asked)
        errors = forecast.squared_errors(one)[0]
        results[actions] = {
            "states": forecast.mean[0, steps - 1].tolist(),
            "error": errors.mean(axis=0).tolist(),
            "diverges_at": diverges_at(errors).tolist(),
        }
    return {
        "horizon": steps.tolist(),
        "names": list(one.state_names),
        "truth": one.states[steps].tolist(),
        "actions": results,
    }


def stored_steps(length: int) -> NDArray[np.intp]:
    """Horizons that are stored: all of them, or of many those where most happens, the first.

    All up to 200, because cartpole's controller switches from step to step.
    """
    if length <= 200:
        return np.arange(1, length + 1)
    return np.unique(np.r_[1:20:2, np.arange(20, length + 1, 12), length])


def diverges_at(errors: NDArray[np.float64]) -> NDArray[np.intp]:
    """For every state, the first horizon from which it is off by more than its training range.

    Parameters
    ----------
    errors : ndarray of shape (H, d_s)
        Squared, in training ranges.

    Returns
    -------
    ndarray of int of shape (d_s,)
        0 where it is not off at the end.
    """
    off = np.logical_and.accumulate(errors[::-1] > DIVERGED)[::-1]
    return np.where(off[-1], off.argmax(axis=0) + 1, 0)


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {"models": MODELS, "n_train": N_EPISODES, "n_test": N_TEST[mode], "tasks": TASKS}


# -- text ---------------------------------------------------------------------------------


def report(tables: Tables) -> str:
    """Normalised error of each state dimension and model."""
    lines = [
        "Squared error in units of the training range, mean over the training length, of one test "
        "episode a seed: median over seeds (least to greatest). Names without (ours) have the "
        'paper\'s settings. "Diverges": off by more than the training range, up to the end.',
        "",
    ]
    for task, some in tables["errors"].groupby("task", sort=False):
        chosen = some.groupby("seed")["episode"].first()
        which = ", ".join(f"{episode} (seed {seed})" for seed, episode in chosen.items())
        some = some.assign(line=named_models(some))
        lines += [f"### {task}", "", f"Test episodes: {which}.", ""]
        lines += [markdown(_error_table(some)), "", _winners(some), ""]
    return "\n".join(lines)


def _error_table(errors: pd.DataFrame) -> pd.DataFrame:
    mean = errors.groupby(["line", "seed"], sort=False)["error"].mean().reset_index()
    mean = mean.assign(state="mean of all", diverges_at=0)
    lines = []
    for state, of_state in pd.concat([errors, mean]).groupby("state", sort=False):
        line = {"state": state}
        for name, some in of_state.groupby("line", sort=False):
            diverged = (some["diverges_at"] > 0).sum()
            note = f", diverges {diverged} of {len(some)}" if diverged else ""
            line[str(name)] = spread(some["error"]) + note
        lines.append(line)
    return pd.DataFrame(lines)


def _winners(errors: pd.DataFrame) -> str:
    """In how many state dimensions each model has the least error (median over seeds)."""
    medians = errors.groupby(["state", "line"], sort=False)["error"].median().unstack("line")
    counts = medians.idxmin(axis=1).value_counts()
    won = "; ".join(f"{line} in {count}" for line, count in counts.items())
    return f"Least error, of {len(medians)} states: {won}."


# -- figures ------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """One figure a task, of the first seed."""
    first = min(tables["states"]["seed"])
    states, errors = (table[table["seed"] == first] for table in tables.values())
    errors = errors[errors["diverges_at"] > 0]
    return {
        f"state-predictions-{task}": _draw_task(some, errors[errors["task"] == task], str(task))
        for task, some in states.groupby("task", sort=False)
    }


def _draw_task(states: pd.DataFrame, errors: pd.DataFrame, task: str) -> Any:
    import matplotlib.pyplot as plt

    names, n_columns = list(states["state"].unique()), COLUMNS[task]
    n_rows = len(names) // n_columns
    figure, grid = plt.subplots(
        n_rows, n_columns, figsize=(9.5, 1.2 + 2.1 * n_rows), layout="constrained", sharex=True
    )
    seed, episode = states[["seed", "episode"]].iloc[0]
    figure.suptitle(f"{task}, test episode {episode} of seed {seed}", x=0.01, ha="left", size=10)
    gone = set(zip(errors["state"], named_models(errors)))
    # the states of one kind, cos, sin or velocity of several joints, stand in a column
    axes = grid.T.ravel() if n_rows > n_columns else grid.ravel()
    for ax, name in zip(axes, names, strict=True):
        some = states[states["state"] == name]
        ax.plot(some["horizon"], some["truth"], **TRUTH)
        ax.set_ylim(limits(states, [n for n in names if kind_of(n) == kind_of(name)], gone))
        for line, style in DRAWN.items():
            draw_curve(ax, some.assign(middle=some[line]), style, line, band=None)
            if (name, line) in gone:
                _say_diverges(ax, some["horizon"].to_numpy(), some[line].to_numpy(), line, style)
        unit = UNITS[kind_of(name)]
        ax.set_title(f"{name} ({unit})" if unit else name, loc="left", fontsize=9)
        tidy(ax)
    for ax in grid[-1]:
        ax.set_xlabel("horizon (steps)")
    legend_below(figure, axes[0], ncols=len(DRAWN) + 1)
    return figure


def kind_of(name: str) -> str:
    """Of a state of reacher what it measures, without the joint; else the name itself."""
    return name if name in UNITS else name.partition("_")[0]


def limits(
    states: pd.DataFrame, names: list[str], gone: set[tuple[str, str]]
) -> tuple[float, float]:
    """Limits that states of one kind share: a line far off does not squash the truth."""
    some = states[states["state"].isin(names)]
    truth = some["truth"]
    kept = [line for line in DRAWN if not any((name, line) in gone for name in names)]
    low, high = some[["truth", *kept]].min().min(), some[["truth", *kept]].max().max()
    span = truth.max() - truth.min()
    margin = 0.05 * span
    return max(low, truth.min() - span) - margin, min(high, truth.max() + span) + margin


def _say_diverges(
    ax: "Axes", horizon: NDArray[Any], values: NDArray[Any], line: str, style: int
) -> None:
    low, high = ax.get_ylim()
    outside = np.flatnonzero((values < low) | (values > high))
    if len(outside):
        i = outside[0]
        top = values[i] > high
        ax.annotate(
            f"{line} diverges",
            (horizon[i], high if top else low),
            xytext=(4, -3 if top else 3),
            textcoords="offset points",
            va="top" if top else "bottom",
            fontsize=8,
            color=line_style(style)["color"],
            bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1},
            zorder=5,
        )


BENCHMARK = Benchmark("state-predictions", __doc__, run, report, draw, settings, minutes=6)

if __name__ == "__main__":
    BENCHMARK.main()
