"""Whether predicted uncertainty explodes: its growth over the horizon beside that of the error."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.paper._command import markdown
from benchmarks.paper._intervals import rounded
from benchmarks.paper._uncertainty_tables import LOGGED, place

#: Horizons whose growth is compared.
GROWTH = (10, 200)
#: Growth from which on an uncertainty is said to explode, and ratio of the growth of std to that
#: of the error within which the two are said to grow together.
EXPLODES, TOGETHER = 10.0, (0.5, 2.0)
#: Models of the verdict, by formulation. On real flights P and PE replay the log.
FORMULATIONS = {
    f"one-step, {LOGGED}": [f"P, {LOGGED}", f"PE, {LOGGED}"],
    "one-step, actions recomputed": ["P", "PE"],
    "trajectory": ["TP", "TPE", "T"],
}
_VERDICTS = ["faster than the error", "with the error", "more slowly than the error", "diverged"]


class Grown(NamedTuple):
    """Growth of one model on one task: factors, std / error at both ends, last std in ranges."""

    task: str
    noise: float
    model: str
    first: int
    last: int
    std: float
    error: float
    before: float
    after: float
    last_std: float

    @property
    def verdict(self) -> str:
        """How std grows, one of `_VERDICTS`."""
        with np.errstate(invalid="ignore"):
            ratio = np.divide(self.std, self.error)
        if np.isnan(ratio):
            return _VERDICTS[3]
        return _VERDICTS[int(ratio <= TOGETHER[1]) + int(ratio < TOGETHER[0])]

    @property
    def formulation(self) -> str | None:
        """Which of `FORMULATIONS`, if any."""
        replays = self.task == "real" and self.model in ("P", "PE")
        model = f"{self.model}, {LOGGED}" if replays else self.model
        return next((name for name, some in FORMULATIONS.items() if model in some), None)


def grown(growth: pd.DataFrame) -> Iterator[Grown]:
    """Growth of every model on every task, of medians over seeds."""
    first, end = GROWTH
    for (task, noise, model), some in growth.groupby(["task", "noise", "model"], sort=False):
        by = some.groupby("horizon")[["std", "error"]].agg(_median)
        last = int(min(end, by.index.max()))
        (s0, e0), (s1, e1) = by.loc[first], by.loc[last]
        with np.errstate(divide="ignore", invalid="ignore"):
            std, error, before, after = np.divide([s1, e1, s0, s1], [s0, e0, e0, e1])
        yield Grown(task, noise, model, first, last, std, error, before, after, s1)


def _median(values: pd.Series) -> float:
    """Median in which NaN stays."""
    return float(np.median(values))


def growth_table(growth: pd.DataFrame) -> pd.DataFrame:
    """How much std and error grow, their quotient at both ends, and the last std."""
    lines = []
    for one in grown(growth):
        line = {"task": place(one.task, one.noise), "model": one.model}
        line |= {f"std x ({one.first} to {one.last})": times(one.std)}
        line |= {"error x": times(one.error)}
        line |= {f"std / error at {one.first}": times(one.before)}
        line |= {f"std / error at {one.last}": times(one.after)}
        line |= {f"std at {one.last} / range": rounded(one.last_std)}
        lines.append(line)
    return pd.DataFrame(lines)


def times(value: float) -> str:
    """A factor; infinite or undefined after a divergence."""
    return rounded(value) if np.isfinite(value) else "diverged"


def verdict(growth: pd.DataFrame) -> list[str]:
    """What holds of an uncertainty that explodes: counts, and a sentence a task and noise."""
    every = [one for one in grown(growth) if one.formulation is not None]
    counts = [
        _counted(name, [one for one in every if one.formulation == name]) for name in FORMULATIONS
    ]
    lines = [
        f"Growth from step {GROWTH[0]} to the last of the predicted std (raw) and of the actual "
        "error against what was measured, medians over test episodes and seeds. With the error: "
        f"the growth of std is {TOGETHER[0]:g} to {TOGETHER[1]:g} times that of the error; faster "
        "and more slowly: above and below. The rule is about growth alone: a std may grow rightly "
        f"and be too small or too large throughout. Explodes: std grows more than {EXPLODES:g} "
        "times. A forecast is a model on a task with a noise; on real flights P and PE replay "
        "logged actions.",
        "",
        markdown(pd.DataFrame([line for line in counts if line["forecasts"]])),
        "",
    ]
    for where in dict.fromkeys((one.task, one.noise) for one in every):
        lines.append(_sentence([one for one in every if (one.task, one.noise) == where]))
    return lines


def _counted(formulation: str, some: list[Grown]) -> dict[str, Any]:
    # not (at most so much): what is undefined has diverged
    exploding = [one for one in some if not one.std <= EXPLODES]
    truly = [one for one in exploding if not one.error <= EXPLODES]
    line = {"formulation": formulation, "forecasts": len(some)}
    line |= {"std explodes": len(exploding), "of these the error, too": len(truly)}
    return line | {name: sum(one.verdict == name for one in some) for name in _VERDICTS}


def _sentence(some: list[Grown]) -> str:
    parts = []
    for name in _VERDICTS:
        of_it = [_factors(one) for one in some if one.verdict == name]
        if of_it:
            said = name if name == _VERDICTS[3] else f"std grows {name}"
            parts.append(f"{said}: {', '.join(of_it)}")
    one = some[0]
    return f"- {place(one.task, one.noise)} ({one.first} to {one.last}): {'; '.join(parts)}."


def _factors(one: Grown) -> str:
    std, error = (f"x {rounded(v)}" if np.isfinite(v) else times(v) for v in (one.std, one.error))
    return f"{one.model} ({std}, error {error})"
