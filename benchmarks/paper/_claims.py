"""The paper's claims as comparisons that can fail, and the verdict that follows from them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from benchmarks.paper._command import Tables
from benchmarks.paper._intervals import by_seed, ratio, ratio_of_each_seed

#: Tables by benchmark.
Sources = dict[str, Tables]

#: Where a roll-out takes its actions from, as a condition reads.
ACTIONS = {"logged": "logged actions", "policy": "recomputed actions"}
#: Settings as a condition reads, and how they mark the name of a model.
SETTINGS = {"paper's settings": "", "tuned (our defaults)": " (ours)"}
#: How far apart two errors may be that are called the same.
SAME = 1.5


@dataclass(frozen=True)
class Comparison:
    """One measured ratio; above 1 it speaks for the claim (or, if `same`, near 1).

    Attributes
    ----------
    condition : str
        Where it was measured: task, settings, actions.
    what : str
        What is divided by what.
    estimate, low, high : float
        Ratio, and the ends of its interval; NaN where only seeds are known.
    seeds : tuple of float
        The ratio of each seed.
    same : bool
        Whether the claim is that there is no difference worth mentioning.
    """

    condition: str
    what: str
    estimate: float
    low: float
    high: float
    seeds: tuple[float, ...]
    same: bool = False

    @property
    def verdict(self) -> str:
        """Whether it speaks "for" the claim, "against" it, or is "open".

        The interval tells of the test episodes, the seeds of training: both must agree.
        """
        interval = [value for value in (self.low, self.high) if not np.isnan(value)]
        ends = [*interval, *self.seeds]
        if not ends or np.isnan(ends).any():  # one infinite error over another tells nothing
            return "open"
        least, most = min(ends), max(ends)
        if self.same:
            if least > 1 / SAME and most < SAME:
                return "for"
            return "against" if least > SAME or most < 1 / SAME else "open"
        if least > 1:
            return "for"
        return "against" if most < 1 else "open"


@dataclass(frozen=True)
class Claim:
    """What the paper says, and what was measured."""

    title: str
    says: str
    comparisons: Sequence[Comparison]
    notes: Sequence[str] = field(default=())
    figure: str | None = None

    @property
    def verdict(self) -> str:
        """ "holds", "holds only if", "fails" or "open"; "not measured" without comparisons."""
        each = {comparison.verdict for comparison in self.comparisons}
        if not each:
            return "not measured"
        if each == {"for"}:
            return "holds"
        if self.conditions("for"):
            return "holds only if"
        return "fails" if "against" in each else "open"

    def conditions(self, verdict: str) -> list[str]:
        """Conditions under which all comparisons have a verdict, in order."""
        met: dict[str, bool] = {}
        for one in self.comparisons:
            met[one.condition] = met.get(one.condition, True) and one.verdict == verdict
        return [condition for condition, all_of_it in met.items() if all_of_it]

    def mixed(self) -> list[str]:
        """Conditions that speak neither for the claim nor against it throughout."""
        clear = {*self.conditions("for"), *self.conditions("against")}
        return [
            name
            for name in dict.fromkeys(one.condition for one in self.comparisons)
            if name not in clear
        ]

    def effect(self, verdict: str) -> str:
        """How many comparisons have a verdict, with their least and greatest ratio."""
        ratios = [one.estimate for one in self.comparisons if one.verdict == verdict]
        if not ratios:
            return "0"
        if len(ratios) == 1:
            return f"1 ({number(ratios[0])})"
        return f"{len(ratios)} ({number(min(ratios))} to {number(max(ratios))})"


def to_tables(claims: Sequence[Claim]) -> dict[str, pd.DataFrame]:
    """Claims as two tables: ``claims``, a line each, and ``comparisons``."""
    statements = [
        {
            "claim": one.title,
            "says": one.says,
            "figure": one.figure or "",
            "notes": "\n".join(one.notes),
        }
        for one in claims
    ]
    comparisons = [
        {"claim": claim.title}
        | asdict(one)
        | {"seeds": " ".join(f"{value:.5g}" for value in one.seeds)}
        for claim in claims
        for one in claim.comparisons
    ]
    return {"claims": pd.DataFrame(statements), "comparisons": pd.DataFrame(comparisons)}


def from_tables(tables: dict[str, pd.DataFrame]) -> list[Claim]:
    """Claims that `to_tables` wrote."""
    measured: dict[str, list[Comparison]] = {}
    for line in tables["comparisons"].to_dict("records"):
        title = line.pop("claim")
        seeds = tuple(float(value) for value in str(line.pop("seeds")).split())
        measured.setdefault(title, []).append(Comparison(**line, seeds=seeds))
    return [
        Claim(
            line["claim"],
            line["says"],
            measured.get(line["claim"], []),
            notes=line["notes"].splitlines(),
            figure=line["figure"] or None,
        )
        for line in tables["claims"].fillna("").to_dict("records")
    ]


def number(value: float) -> str:
    """Two significant digits, as the tables print them."""
    if np.isinf(value):
        return "∞" if value > 0 else "-∞"
    return "?" if np.isnan(value) else f"{value:.2g}"


def compare(
    episodes: pd.DataFrame,
    above: dict[str, Any],
    below: dict[str, Any],
    column: str,
    *,
    condition: str,
    what: str,
    same: bool = False,
) -> Comparison:
    """Ratio of median errors of two selections of a table of test episodes.

    Parameters
    ----------
    episodes : DataFrame
        A line a seed and test episode.
    above, below : dict
        Values of columns that select the lines of numerator and denominator.
    column : str
        The error.
    condition, what, same
        Of the `Comparison`.
    """
    a, b = (by_seed(_selected(episodes, chosen), column) for chosen in (above, below))
    return Comparison(
        condition, what, *ratio(a, b), seeds=tuple(ratio_of_each_seed(a, b)), same=same
    )


def compare_seeds(
    a: ArrayLike, b: ArrayLike, *, condition: str, what: str, same: bool = False
) -> Comparison:
    """Ratio of two numbers that are known once a seed: median, and no interval but the seeds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.asarray(a, dtype=np.float64) / np.asarray(b, dtype=np.float64)
    if not len(ratios):
        raise ValueError(f"there is no seed to compare for {what!r} ({condition}).")
    middle = float(np.median(ratios))
    return Comparison(condition, what, middle, np.nan, np.nan, tuple(ratios.tolist()), same)


def _selected(table: pd.DataFrame, chosen: dict[str, Any]) -> pd.DataFrame:
    """Lines with these values; an error says what is missing."""
    for column, value in chosen.items():
        table = table[table[column] == value]
    if table.empty:
        raise ValueError(f"the results have no lines with {chosen}: run the benchmark again.")
    return table
