"""The target of calibration: what intervals cover, what calibration costs, what chance allows."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.paper._command import markdown
from benchmarks.paper._intervals import rounded
from benchmarks.paper._uncertainty_scores import LEVEL
from benchmarks.paper._uncertainty_tables import mean, percent, place, steps

#: What a calibrated interval of 90 % should cover, and the most that calibration may cost.
TARGET, COST = (0.88, 0.92), 1.02
_SIZES = ["n_calibration", "n_episodes"]
_CELL = ["task", "noise", "model", "first", "last", *_SIZES]
_MEASURES = ["coverage90", "crps", "nll"]
_N_DRAWS = 100_000


class Chance(NamedTuple):
    """What an interval that is exactly right covers, of one state at one horizon."""

    std: float
    one: float
    several: float


def chance(n_calibration: int, n_test: int, n_seeds: int) -> Chance:
    """Standard deviation of the tested coverage, and how likely it meets the target.

    Behind n calibration episodes the coverage has the distribution Beta(k, n + 1 - k), with k the
    rank of the residual that is the half width; the hits among the test episodes are then
    beta-binomial. ``one`` is the probability for one seed, ``several`` that for the mean of all.
    """
    # the tolerance: 0.9 (n + 1) of a whole number may come out above it
    rank = int(np.ceil((n_calibration + 1) * LEVEL - 1e-9))
    if rank > n_calibration:  # the interval is infinite
        return Chance(0.0, 0.0, 0.0)
    hits = stats.betabinom(n_test, rank, n_calibration + 1 - rank)
    drawn = hits.rvs((_N_DRAWS, n_seeds), random_state=0) / n_test
    one, several = (_meets(some).mean() for some in (drawn[:, 0], drawn.mean(axis=1)))
    return Chance(float(hits.std() / n_test), float(one), float(several))


def perfect_coverage(n_particles: int) -> float:
    """Coverage of an interval whose std is that of so many particles of a perfect model.

    The mean is not that of the particles: the quotient of error and std is t distributed, up to
    the factor of a variance that is divided by the number of particles.
    """
    half = stats.norm.ppf((1 + LEVEL) / 2)
    inside = half * np.sqrt((n_particles - 1) / n_particles)
    return float(1 - 2 * stats.t(n_particles - 1).sf(inside))


def checked(main: pd.DataFrame, *, each_seed: bool = False) -> pd.DataFrame:
    """Of each cell: coverage, and what calibration costs; means over seeds, or seed by seed.

    Columns ``covered``; ``ratio`` (CRPS calibrated / raw) and ``change`` (NLL calibrated - raw),
    both NaN where they are infinite before and after; ``inside``, ``cheap`` and ``no_worse``:
    whether they meet the target.
    """
    keys = [*_CELL, "seed"] if each_seed else _CELL
    by_kind = {
        kind: main[main["kind"] == kind].groupby(keys, sort=False)[_MEASURES].agg(mean)
        for kind in ("raw", "conformal")
    }
    raw, conformal = by_kind["raw"], by_kind["conformal"]
    table = pd.DataFrame({"covered": conformal["coverage90"]})
    with np.errstate(invalid="ignore"):
        table["ratio"] = conformal["crps"] / raw["crps"]
        table["change"] = conformal["nll"] - raw["nll"]
    table["inside"] = _meets(table["covered"])
    return table.assign(cheap=table["ratio"] <= COST, no_worse=table["change"] <= 0).reset_index()


def target(main: pd.DataFrame) -> list[str]:
    """Whether calibrated intervals cover what they should, at what cost; exceptions by name."""
    table, each = checked(main), checked(main, each_seed=True)
    n_seeds = main["seed"].nunique()
    covers = f"covers {percent(TARGET[0])} to {percent(TARGET[1])}"
    lines = []
    for (n, m), some in sorted(table.groupby(_SIZES), reverse=True):
        alone = each[(each["n_calibration"] == n) & (each["n_episodes"] == m)]
        by_chance = chance(n, m, n_seeds)
        line = {
            "calibration / test episodes": f"{n} / {m}",
            covers: _share(some["inside"]),
            "one seed at a time": _share(alone["inside"]),
            f"CRPS at most {COST:g} x raw": _share(some["cheap"]),
            "NLL no worse than raw": _share(some["no_worse"]),
            "chance: std of coverage": rounded(by_chance.std),
            "chance: target met, one seed": percent(by_chance.one),
        }
        if n_seeds > 1:
            line[f"chance: mean of {n_seeds}"] = percent(by_chance.several)
        lines.append(line)
    return [
        f"In how many cells (task, noise, model, bin) the calibrated {percent(LEVEL)} interval "
        "covers what it should, and what calibration does to the scores; of means over seeds where "
        "nothing else is said. Chance: of one state at one horizon, if the calibration is exactly "
        "right, because the calibration and test episodes are so few (beta-binomial). A bin "
        "averages over many states and horizons that depend strongly on one another, and scatters "
        "somewhat less.",
        "",
        markdown(pd.DataFrame(lines)),
        "",
        *_exceptions(table),
    ]


def _meets(covered: pd.Series) -> pd.Series:
    return (covered >= TARGET[0]) & (covered <= TARGET[1])


def _share(met: pd.Series) -> str:
    return f"{met.sum()} of {len(met)}"


def _exceptions(table: pd.DataFrame) -> list[str]:
    lines = []
    for what, met, column, digits, sign in (
        ("Coverage outside", "inside", "covered", 4, ""),
        (f"CRPS above {COST:g} x raw", "cheap", "ratio", 3, ""),
        ("NLL above the raw one, by", "no_worse", "change", 2, "+"),
    ):
        missed = table[~table[met]]
        if len(missed):
            lines.append(f"- {what}: {_named(missed, column, digits, sign)}.")
    return lines


def _named(missed: pd.DataFrame, column: str, digits: int, sign: str) -> str:
    parts = []
    for (task, noise, model), few in missed.groupby(["task", "noise", "model"], sort=False):
        values = [
            f"{steps(first, last)}: {_number(value, digits, sign)}"
            for first, last, value in few[["first", "last", column]].itertuples(index=False)
        ]
        parts.append(f"{place(task, noise)}, {model} ({', '.join(values)})")
    return "; ".join(parts)


def _number(value: float, digits: int, sign: str) -> str:
    return "infinite before and after" if np.isnan(value) else sign + rounded(value, digits)
