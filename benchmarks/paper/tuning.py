"""Are the paper's hyper-parameters the best of its own sweeps, and of a little beyond?

One parameter at a time around its final value, by `GridSearchCV` over training episodes (3 folds):
D with recomputed and with logged actions, T and the LSTM; shorter training than the paper's final
one. Each sweep of learning rates has one higher rate that the paper did not try; the optimizer is
always Adam. (The paper: its table of tuned parameters.)
"""

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from sklearn.exceptions import FitFailedWarning
from sklearn.model_selection import GridSearchCV, KFold

from benchmarks.paper import _tasks
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._grids import BEYOND, FINAL, SWEPT, origin, others, setting, values
from benchmarks.paper._rollouts import action_sources
from benchmarks.paper._tasks import TASKS, environment
from benchmarks.paper._tuning_report import draw, report
from trajlearn import TrajectoryDataset, horizon_errors, paper
from trajlearn.exceptions import DivergenceWarning

N_FOLDS = 3


class Plan(NamedTuple):
    """What is swept on a task: epochs of each fit, and parameters (None takes all)."""

    task: str
    model: str
    epochs: int
    parameters: tuple[str, ...] | None = None


_NETWORK = ("width", "depth", "batch size", "learning rate")
PLANS = {
    "full": [
        Plan("cartpole", "D", 12),
        Plan("cartpole", "T", 2),
        Plan("cartpole", "LSTM", 4),
        Plan("reacher", "T", 2, ("learning rate",)),
    ],
    "quick": [
        Plan("cartpole", "D", 2),
        Plan("cartpole", "T", 1, _NETWORK),
        Plan("cartpole", "LSTM", 1, ("learning rate",)),
    ],
}


def cell(
    task: str, model: str, epochs: int, grid: list[dict[str, Any]], n_episodes: int, seed: int
) -> list[dict[str, Any]]:
    """Scores of settings of the paper's model on every fold: one `GridSearchCV`.

    Parameters
    ----------
    task, model : str
    epochs : int
    grid : list of dict
        Settings to compare.
    n_episodes : int
    seed : int
        Of the episodes, the folds and the model.

    Returns
    -------
    list of dict
        One a setting: metrics by fold, and the mean ``fit_seconds``.
    """
    env = environment(task)
    ds = env.collect(n_episodes, TASKS[task].length, random_state=2 * seed)
    policy = {} if model == "T" else {"policy": env.policy}
    estimator = paper.model(model, random_state=seed, error_score=-np.inf, **policy)
    estimator.set_params(**{"max_epochs" if model == "LSTM" else "estimator__max_epochs": epochs})
    search = GridSearchCV(
        estimator,
        [{name: [value] for name, value in settings.items()} for settings in grid],
        scoring=Errors(action_sources(model)),
        cv=KFold(N_FOLDS, shuffle=True, random_state=seed),
        refit=False,
        # a fit that fails has an infinite error, which is never dropped
        error_score=-np.inf,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        warnings.simplefilter("ignore", FitFailedWarning)
        warnings.filterwarnings("ignore", message="One or more of the test scores are non-finite")
        warnings.filterwarnings("ignore", message="invalid value encountered in subtract")
        found = search.fit(ds).cv_results_
    metrics = [name.removeprefix("split0_test_") for name in found if name.startswith("split0")]
    return [
        {m: [found[f"split{k}_test_{m}"][i] for k in range(N_FOLDS)] for m in metrics}
        | {"fit_seconds": found["mean_fit_time"][i]}
        for i in range(len(grid))
    ]


@dataclass(frozen=True)
class Errors:
    """Scorer: minus the error of the held-out episodes, for each source of actions.

    The mean is the estimator's own `score`; the median is over episodes.
    """

    sources: list[str]

    def __call__(self, estimator: Any, X: TrajectoryDataset, y: None = None) -> dict[str, float]:
        """Score a fitted estimator."""
        scores = {"steps": float(estimator.estimator_.n_steps_)}
        for source in self.sources:
            asked = {} if source == "none" else {"actions": source}
            errors = horizon_errors(estimator.predict(X, **asked), X).to_numpy().mean(axis=1)
            scores |= {f"{source}_mean": -errors.mean(), f"{source}_median": -np.median(errors)}
        return scores


def run(run: Run) -> Tables:
    """Scores of every value on every fold."""
    asked, cells = [], []
    for plan in PLANS[run.mode]:
        for parameter in ("final", *(plan.parameters or SWEPT[plan.model])):
            for seed in run.seeds:
                asked.append((plan, parameter))
                cells.append(_cell(plan, parameter, seed))
    tables, final = [], {}
    for (plan, parameter), sent, results in zip(asked, cells, run.cells(cells, cell), strict=True):
        key = {"task": plan.task, "model": plan.model, "parameter": parameter}
        of = (plan.task, plan.model, sent["seed"])
        if parameter == "final":
            [final[of]] = results
            continue
        results = dict(zip(others(plan.model, parameter), results, strict=True))
        for value in values(plan.model, parameter):
            result = results.get(value, final[of])
            line = key | {"value": value, "origin": origin(plan.model, parameter, value)}
            line["seed"] = sent["seed"]
            for source in reversed(action_sources(plan.model)):
                tables.append(_by_fold(line, source, result))
    return {"scores": pd.concat(tables, ignore_index=True)}


def _cell(plan: Plan, parameter: str, seed: int) -> dict[str, Any]:
    # the final value is in every sweep: it is fitted once
    grid: list[dict[str, Any]] = [{}]
    if parameter != "final":
        asked = others(plan.model, parameter)
        grid = [setting(plan.model, parameter, value, plan.epochs) for value in asked]
    cell = {"task": plan.task, "model": plan.model, "epochs": plan.epochs, "grid": grid}
    return cell | {"n_episodes": _tasks.N_EPISODES, "seed": seed}


def _by_fold(line: dict[str, Any], source: str, result: dict[str, Any]) -> pd.DataFrame:
    """A line a fold: the errors, positive."""
    errors = {name: -np.array(result[f"{source}_{name}"]) for name in ("mean", "median")}
    # a failed fit has no steps
    steps = np.array(result["steps"])
    steps = np.where(np.isfinite(steps), steps, np.nan)
    folds = {"fold": range(N_FOLDS), "actions": source, "steps": steps}
    return pd.DataFrame(line | folds | errors | {"fit_seconds": result["fit_seconds"]})


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    plans = [plan._asdict() for plan in PLANS[mode]]
    facts = {"plans": plans, "swept": SWEPT, "final": FINAL, "beyond": BEYOND, "folds": N_FOLDS}
    return facts | {"n_episodes": _tasks.N_EPISODES, "optimizer": "Adam"}


BENCHMARK = Benchmark("tuning", __doc__, run, report, draw, settings, minutes=15)

if __name__ == "__main__":
    BENCHMARK.main()
