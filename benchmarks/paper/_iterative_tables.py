"""Best returns so far, on a scale where 1 is the best known, and what follows from them."""

from typing import NamedTuple

import pandas as pd

from benchmarks.paper._command import Tables
from benchmarks.paper._control_tasks import normalised
from benchmarks.paper._iterative_methods import BO, BO_LATER, N_SOBOL

#: Shares of the repeats between the percentiles that are shown, as in the paper's code.
INNER, OUTER = 0.66, 0.95
#: A median this near to the best known return counts as solved.
NEAR = 0.95


class Result(NamedTuple):
    """What a run found on one task.

    `best` is that of the simulator's own search, or, `by_a_trial`, of a trial that is better;
    `trials` has the normalised columns `true` and `seen` of each trial, their best so far
    (`best_true`, `best_seen`), and `kept`: `true` of the theta with the best trial so far.
    """

    task: str
    trials: pd.DataFrame
    best: float
    by_a_trial: bool
    floor: float
    scale: pd.Series

    def by_trial(self, method: str, column: str) -> pd.DataFrame:
        """Values of a method, a row a repeat and a column a trial."""
        some = self.trials[self.trials["method"] == method]
        return some.pivot(index="repeat", columns="trial", values=column)

    @property
    def methods(self) -> list[str]:
        """In the order of the run."""
        return list(dict.fromkeys(self.trials["method"]))


def result(tables: Tables) -> Result:
    """Normalise the tables of one task."""
    [task] = [stem for stem in tables if not stem.endswith("-scale")]
    trials, scale = tables[task].copy(), tables[f"{task}-scale"].iloc[0]
    # never less than the best that any trial showed
    known, tried, floor = (float(v) for v in (scale["test"], trials["true"].max(), scale["floor"]))
    best = max(known, tried)
    for column in ("true", "seen"):
        trials[column] = normalised(trials[column], floor, best)
    trials = trials.sort_values("trial", kind="stable")
    by_repeat = trials.groupby(["method", "repeat"], sort=False)
    for column in ("true", "seen"):
        trials[f"best_{column}"] = by_repeat[column].cummax()
    # the first of equals is kept
    earlier = trials.groupby(["method", "repeat"], sort=False)["best_seen"].shift()
    trials["kept"] = trials["true"].where(~(trials["seen"] <= earlier))
    trials["kept"] = trials.groupby(["method", "repeat"], sort=False)["kept"].ffill()
    return Result(task, trials.sort_index(), best, tried > known, floor, scale)


def spread(values: pd.DataFrame, share: float) -> tuple[pd.Series, pd.Series]:
    """Percentiles between which a share of the repeats lies, by trial."""
    return values.quantile((1 - share) / 2), values.quantile((1 + share) / 2)


def first_near(values: pd.DataFrame) -> int | None:
    """First trial at which the median is within 5 % of the best known; None if at none."""
    medians = values.median()
    near = medians.index[medians >= NEAR]
    return int(near[0]) if len(near) else None


def behind(of: Result, method: str, column: str) -> pd.Series:
    """Share of the repeats in which a method is behind Bayesian optimisation, by trial."""
    mine, other = of.by_trial(method, column), of.by_trial(BO, column)
    return (mine < other).mean()


def median_behind(of: Result, method: str, column: str) -> pd.Series:
    """By how much the median is behind that of Bayesian optimisation, by trial from the second.

    Trials where it is not behind are left out.
    """
    gap = of.by_trial(BO, column).median() - of.by_trial(method, column).median()
    gap = gap[gap.index >= 2]
    return gap[gap > 0]


def seconds(of: Result, method: str, column: str) -> float:
    """Median time of a proposal that a model makes: not of the first ones, which are drawn.

    NaN if all are.
    """
    drawn = N_SOBOL if method == BO_LATER else 1
    some = of.trials[(of.trials["method"] == method) & (of.trials["trial"] > drawn)]
    return float(some[column].median())
