"""Are roll-outs better with logged or with recomputed actions?

PE with the paper's settings and D with ours, on cartpole and reacher. A roll-out takes its
actions from the log of the episode that it predicts, or asks the policy at every predicted
state. The logged ones are an oracle: they exist only once the episode has been run. The paper
finds a greater error with recomputed actions; here the ratio of errors is measured, with an
interval. (The paper: its figure on the source of actions, PE on cartpole.)

Logged actions are open loop: they correct no error of a prediction, and an unstable plant
amplifies it. Recomputed ones correct it as the controller would correct a disturbance, but carry
errors of the predicted state into the actions.
"""

from typing import Any

import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._intervals import by_seed, ratio, ratio_of_each_seed, rounded, spread
from benchmarks.paper._rollouts import N_TEST, measure
from benchmarks.paper._tasks import N_EPISODES, TASKS
from benchmarks.paper.horizon_error import (
    WINDOWS,
    draw_lines,
    named_models,
    summary,
    window_titles,
)

MODELS = [("PE", "paper"), ("D", "default")]


def run(run: Run) -> Tables:
    """Curves, errors by episode, and ratios of errors."""
    tables = measure(run, list(TASKS), MODELS)
    episodes = tables["episodes"].drop(columns=["within", "reward"])
    return {
        "curves": tables["curves"].drop(columns="mean"),
        "episodes": episodes,
        "ratios": ratios(episodes),
    }


def ratios(episodes: pd.DataFrame) -> pd.DataFrame:
    """Error with logged actions / error with recomputed ones: a line a task, model and window."""
    lines = []
    for (task, model), some in episodes.groupby(["task", "model"], sort=False):
        logged, policy = (some[some["actions"] == source] for source in ("logged", "policy"))
        for window in WINDOWS:
            pair = by_seed(logged, window), by_seed(policy, window)
            each = ratio_of_each_seed(*pair)
            of_seeds = {"least_seed": min(each), "greatest_seed": max(each)}
            key = {"task": task, "model": model, "window": window}
            lines.append(key | ratio(*pair)._asdict() | of_seeds)
    return pd.DataFrame(lines)


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {"models": MODELS, "n_train": N_EPISODES, "n_test": N_TEST[mode], "tasks": TASKS}


def report(tables: Tables) -> str:
    """Errors with both sources of actions, their ratios, and what follows."""
    lines = [
        "Squared error in units of the training range: mean over a window of horizons (steps), "
        "median over test episodes, median over seeds (least to greatest). Diverged: episodes "
        "whose error is infinite, of all episodes of all seeds.",
        "",
        "Logged / recomputed is the ratio of these medians: above 1 recomputed actions are "
        "better. Behind it, its 95 % interval over test episodes, paired, and its least and "
        "greatest value over seeds.",
        "",
    ]
    for task, some in tables["episodes"].groupby("task", sort=False):
        of_task = tables["ratios"].query("task == @task")
        lines += [f"### {task}", "", markdown(summary(some, str(task))), ""]
        lines += [markdown(_ratio_table(of_task, str(task))), ""]
        lines += [*findings(of_task, str(task)), ""]
        lines += [*_crossings(tables["curves"].query("task == @task"), str(task)), ""]
    return "\n".join(lines)


def _ratio_table(ratios: pd.DataFrame, task: str) -> pd.DataFrame:
    titles = window_titles(task)
    # three digits: some ratios are close to 1
    numbers = ["estimate", "low", "high", "least_seed", "greatest_seed"]
    text = ratios[numbers].map(lambda value: rounded(value, 3))
    return pd.DataFrame(
        {
            "model": ratios["model"],
            "horizon": ratios["window"].map(titles),
            "logged / recomputed": text["estimate"],
            "95 % interval": text["low"] + " to " + text["high"],
            "seeds": text["least_seed"] + " to " + text["greatest_seed"],
        }
    )


def findings(ratios: pd.DataFrame, task: str) -> list[str]:
    """Which source is better, by window; open where interval or seeds fall on both sides of 1."""
    lines = []
    for model, some in ratios.groupby("model", sort=False):
        least = some[["low", "least_seed"]].min(axis=1)
        greatest = some[["high", "greatest_seed"]].max(axis=1)
        found = {
            "recomputed actions are better": least > 1,
            "logged actions are better": greatest < 1,
            "the difference may be chance": (least <= 1) & (greatest >= 1),
        }
        parts = [
            f"{text} at {' and '.join(some['window'][where])} horizons"
            for text, where in found.items()
            if where.any()
        ]
        lines.append(f"- {task}, {model}: {'; '.join(parts)}.")
    return lines


def _crossings(curves: pd.DataFrame, task: str) -> list[str]:
    """The last horizon at which logged actions are ahead in the median, over seeds."""
    lines = []
    for model, some in curves.groupby("model", sort=False):
        medians = some.pivot(index=["seed", "horizon"], columns="actions", values="median")
        ahead = (medians["logged"] < medians["policy"]).unstack("horizon")
        last = (ahead * ahead.columns).max(axis=1)
        lines.append(
            f"- {task}, {model}: the last horizon at which logged actions have the smaller median "
            f"is {spread(last)}; 0 means none."
        )
    return lines


def draw(tables: Tables) -> dict[str, Any]:
    """Both models with both sources of actions."""
    curves = tables["curves"]
    line = named_models(curves)
    order = {name: i for i, name in enumerate(line.unique())}
    curves = curves.assign(line=line, style=line.map(order))
    return {"action-source": draw_lines(curves, percentiles=True)}


BENCHMARK = Benchmark("action-source", __doc__, run, report, draw, settings, minutes=4)

if __name__ == "__main__":
    BENCHMARK.main()
