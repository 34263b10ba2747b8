"""Prediction error by horizon on cartpole, reacher and quadrotor: the paper's main comparison.

D, PE, LSTM and T with the paper's settings, and T, T with the controller's features, C (closed
loop), D and LSTM with ours, on 100 test episodes that are twice as long as the training episodes.
One-step and recurrent models are rolled out with logged actions, as the paper does, and with
actions that the policy recomputes from predicted states: all there is before an episode is run.
Median, 65th and 95th percentile over episodes. (The paper: its figure of prediction errors,
panels a to c.)

The real quadrotor (the paper's panel d, and its figure of predicted states) is three public flights
along a trefoil, `load_nanobench_trefoil`: models are tested on the flight that they were not
trained on and, as in the paper, on the training flights. Where the flights are neither given (with
--data) nor can be downloaded, that part is left out.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper import _trefoil, _trefoil_page
from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import (
    draw_curve,
    draw_percentiles,
    horizon_axes,
    legend_below,
    over_seeds,
)
from benchmarks.paper._intervals import by_seed, ratio, rounded, spread
from benchmarks.paper._noise_floor import EXACT
from benchmarks.paper._noise_floor import cell as exact_cell
from benchmarks.paper._rollouts import N_TEST, PRINTED_GAIN, measure, windows
from benchmarks.paper._tasks import N_EPISODES, QUADROTOR, TASKS, shape
from trajlearn.plotting._style import GREY

if TYPE_CHECKING:
    pass

PAPER = ["D", "PE", "LSTM", "T"]
OURS = ["T", "T, features", "C", "D", "LSTM"]
WINDOWS = ["short", "long", "beyond"]
OF_EXACT = (
    f"The {EXACT} is the simulator without its noise, from the same first state and gains: about "
    "what the best possible model has for errors, because nobody knows the noise ahead."
)
ACTIONS = {"none": "", "logged": ", logged", "policy": ", recomputed"}
# look of a line: a model has the same in every figure
STYLES = {"D": 0, "PE": 1, "LSTM": 2, "T": 3, "T (ours)": 4, "C (ours)": 5, "T, features (ours)": 6}
STYLES[EXACT] = 7


def run(run: Run) -> Tables:
    """Curves and errors by episode of all models."""
    models = [(model, "paper") for model in PAPER] + [(model, "default") for model in OURS]
    # no features of what the quadrotor's controller computes: it is linear in state and gains
    few = [pair for pair in models if pair[0] != "T, features"]
    of_quadrotor = measure(run, list(QUADROTOR), few)
    exact = _exact(run)
    tables = measure(run, list(TASKS), models) | {
        f"quadrotor-{stem}": pd.concat([table, exact[stem]], ignore_index=True)
        for stem, table in of_quadrotor.items()
    }
    # what no text or figure here needs: the files are committed
    unused = ["mean", "within", "reward"]
    tables = {stem: table.drop(columns=unused, errors="ignore") for stem, table in tables.items()}
    return tables | _trefoil.run(run)


def _exact(run: Run) -> Tables:
    """What the plant itself, simulated without its noise, has for errors."""
    cells = [
        {"task": task, "mode": run.mode, "seed": seed} for task in QUADROTOR for seed in run.seeds
    ]
    curves, episodes = [], []
    for asked, result in zip(cells, run.cells(cells, exact_cell), strict=True):
        key = {"task": asked["task"], "model": EXACT, "actions": "none", "seed": asked["seed"]}
        curves.append(pd.DataFrame(key | result["curve"]))
        number = {"episode": range(len(result["windows"]["within"]))}
        episodes.append(pd.DataFrame(key | number | result["windows"]))
    return {"curves": pd.concat(curves), "episodes": pd.concat(episodes)}


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "models": {"paper": PAPER, "default": OURS},
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "tasks": TASKS | QUADROTOR,
        "real": _trefoil.settings(),
    }


# -- text ---------------------------------------------------------------------------------


def report(tables: Tables) -> str:
    """Median error in windows of horizons, and which model is best in which."""
    lines = [
        "Squared error in units of the training range: mean over a window of horizons (steps), "
        "median over test episodes, median over seeds (least to greatest). Diverged: episodes "
        "whose error is infinite, of all episodes of all seeds. Names without (ours) have the "
        "paper's settings. Behind a ratio of errors: its 95 % interval over test episodes.",
        "",
    ]
    simulated = pd.concat([tables["episodes"], tables["quadrotor-episodes"]])
    for task, some in simulated.groupby("task", sort=False):
        lines += [f"### {task}", "", markdown(summary(some, str(task))), ""]
        named = some.assign(model=named_models(some))
        as_paper = named[some["model"].isin(PAPER) & (some["actions"] != "policy")]
        lines += ["The paper's comparison (its settings, logged actions):", ""]
        lines += [*best(as_paper, str(task)), ""]
        if task in QUADROTOR:
            lines += [judged(as_paper, str(task)), "", OF_EXACT, ""]
        without = (some["actions"] != "logged") & (some["model"] != EXACT)
        lines += ["Without logged actions, all settings:", ""]
        lines += [*best(named[without], str(task)), ""]
    return "\n".join([*lines, *_trefoil_page.report(tables)])


def summary(episodes: pd.DataFrame, task: str) -> pd.DataFrame:
    """A line a model and source of actions, a column a window of horizons.

    Parameters
    ----------
    episodes : DataFrame
        Of one task, as from `measure`.
    task : str
    """
    titles = window_titles(task)
    lines = []
    for (model, actions), some in episodes.groupby(["model", "actions"], sort=False):
        line = {"model": model, "actions": actions}
        medians = some.groupby("seed")[WINDOWS].median()
        line |= {titles[window]: spread(medians[window]) for window in WINDOWS}
        diverged = np.isinf(some[WINDOWS]).any(axis=1)
        lines.append(line | {"diverged": f"{diverged.sum()} of {len(some)}"})
    return pd.DataFrame(lines)


def best(episodes: pd.DataFrame, task: str) -> list[str]:
    """A line a window: the best model, and how many times its error others have.

    Of many others, the runner-up and the trajectory models, wherever they stand.
    """
    by_model = dict(list(episodes.groupby("model", sort=False)))
    lines = []
    for window, title in window_titles(task).items():
        errors = {model: by_seed(some, window) for model, some in by_model.items()}
        middle = {m: np.median([np.median(e) for e in some]) for m, some in errors.items()}
        first, *others = sorted(errors, key=lambda model: middle[model])
        if np.isinf(middle[first]):
            lines.append(f"- {title}: every model diverges.")
            continue
        few = len(errors) <= len(PAPER)
        named = [m for i, m in enumerate(others) if few or i == 0 or m.startswith("T")]
        text = "; ".join(f"{m} {_times(errors[m], errors[first])}" for m in named)
        least = rounded(middle[first])
        lines.append(f"- {title}: best is {first}, {least}. Times its error: {text}.")
    return lines


def judged(episodes: pd.DataFrame, task: str) -> str:
    """The paper's claim for long horizons, against what is measured in the same setting.

    Parameters
    ----------
    episodes : DataFrame
        Of one task, with the paper's settings, logged actions and the names of the lines.
    task : str
    """
    titles = window_titles(task)
    own = {w: by_seed(episodes[episodes["model"] == "T"], w) for w in WINDOWS}
    verdicts = []
    for model in (name for name in episodes["model"].unique() if name != "T"):
        some = episodes[episodes["model"] == model]
        for window in ("long", "beyond"):
            found = ratio(by_seed(some, window), own[window])
            if found.low > PRINTED_GAIN[0]:
                verdict = "holds"
            elif found.low > 1:
                verdict = "better, by less"
            elif found.high < 1:
                verdict = "T is worse"
            else:
                verdict = "not told apart"
            verdicts.append(f"{model}, {titles[window]}: {verdict}")
    low, high = PRINTED_GAIN
    return (
        f"The paper prints a gain of {low} to {high} times for T beyond 50 steps. "
        f"Here, against {'; '.join(verdicts)}."
    )


def _times(errors: Any, reference: Any) -> str:
    estimate, low, high = ratio(errors, reference)
    if np.isinf(estimate):
        return "diverges"
    doubt = ", not told apart" if low <= 1 <= high else ""
    return f"{rounded(estimate)} ({rounded(low)} to {rounded(high)}{doubt})"


def window_titles(task: str) -> dict[str, str]:
    """Windows of horizons as columns of a table, such as "short, 1-25"."""
    length, test_length = shape(task)
    steps = np.arange(1, test_length + 1)
    of = {window: steps[where] for window, where in windows(length).items()}
    return {window: f"{window}, {of[window][0]}-{of[window][-1]}" for window in WINDOWS}


def ours(table: pd.DataFrame) -> "pd.Series[bool]":
    """Which lines of a table have our settings."""
    return table["model"].str.endswith("(ours)")


def named_models(table: pd.DataFrame) -> "pd.Series[str]":
    """Models with their source of actions, such as "D, logged"."""
    return table["model"] + table["actions"].map(ACTIONS)


# -- figures ------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """The paper's comparison, and the one without logged actions."""
    curves = pd.concat([tables["curves"], tables["quadrotor-curves"]])
    models = curves["model"].unique()
    styles = {m: STYLES[m if m in STYLES else m.removesuffix(" (ours)")] for m in models}
    curves = curves.assign(line=named_models(curves), style=curves["model"].map(styles))
    paper, logged = curves["model"].isin(PAPER), curves["actions"] == "logged"
    as_paper = curves[paper & (curves["actions"] != "policy")]
    fair = curves[(~paper & ~logged) | (curves["model"] == "T")]
    fair = fair.replace({"line": {"T": "T (paper)"}})
    return {
        "horizon-error-paper": draw_lines(as_paper, percentiles=True),
        "horizon-error-ours": draw_lines(fair, percentiles=False),
        **_trefoil_page.draw(tables),
    }


def draw_lines(curves: pd.DataFrame, *, percentiles: bool) -> Any:
    """A column a task, a row a scale of the horizon: linear, and logarithmic for the first steps.

    Parameters
    ----------
    curves : DataFrame
        As from `measure`, with the columns ``line`` (name in the legend) and ``style`` (number).
    percentiles : bool
        Shade up to the 65th and 95th percentile over episodes; else from the least to the
        greatest median over seeds.
    """
    import matplotlib.pyplot as plt

    tasks = list(curves["task"].unique())
    size = (4.75 * len(tasks), 7.0)
    figure, grid = plt.subplots(
        2, len(tasks), figsize=size, layout="constrained", sharey="col", squeeze=False
    )
    for axes, task in zip(grid.T, tasks, strict=True):
        length = shape(task).length
        chosen = curves[curves["task"] == task]
        for ax, scale in zip(axes, ("linear", "log"), strict=True):
            for (line, style), curve in chosen.groupby(["line", "style"], sort=False):
                if percentiles:
                    draw_percentiles(ax, curve, style, line)
                else:
                    draw_curve(
                        ax, over_seeds(curve, ["horizon"]), style, line, band=("low", "high")
                    )
            if scale == "linear":
                horizon_axes(ax, title=task, length=length)
            else:
                ax.axvline(length, color=GREY, lw=1, ls="dotted")
                horizon_axes(ax, title=f"{task}, logarithmic horizon")
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter("{x:g}")
    # every line is in the first or in the last panel
    n_lines = curves["line"].nunique()
    legend_below(figure, grid[0, 0], ncols=4 if n_lines <= 4 else 3, others=(grid[0, -1],))
    return figure


BENCHMARK = Benchmark(
    "horizon-error",
    __doc__,
    run,
    report,
    draw,
    settings,
    minutes=45,
    data=(_trefoil.DATA,),
)

if __name__ == "__main__":
    BENCHMARK.main()
