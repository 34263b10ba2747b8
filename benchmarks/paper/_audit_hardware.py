"""The claim about real flights: what a trajectory model is worth where nobody chose the noise."""

import pandas as pd

from benchmarks.paper._claims import Claim, Comparison, Sources, compare_seeds, number

#: States that models have, as a condition reads.
_STATES = {"attitude": "attitude and rates", "all": "all twelve states"}
_RIVALS = ("D", "PE", "LSTM")


def hardware(sources: Sources) -> Claim:
    """Ratios flight by flight and seed by seed: three flights allow no finer statement."""
    table = sources["horizon-error"].get("real-episodes", pd.DataFrame())
    comparisons = _comparisons(table, "held-out")
    seen = "; ".join(
        f"{one.condition}: {one.what} {number(one.estimate)}"
        for one in _comparisons(table, "in-sample")
    )
    return Claim(
        "On a real quadrotor time dependence alone helps far ahead",
        "With one set of gains in all flights, T has up to a tenth of the error of one-step models "
        "beyond 50 steps. (The paper tests on the flights that it trains on.)",
        comparisons,
        notes=[
            "Public flights of a Crazyflie under its default PID, each held out in turn; the "
            "paper's are not public. A ratio for each held-out flight and seed. "
            + _clock(table)
            + (f" On the training flights, as the paper tests: {seen}." if seen else "")
        ],
        figure="horizon-error/horizon-error-quadrotor-real.png",
    )


def _clock(table: pd.DataFrame) -> str:
    """What a forecast has for errors that knows the time of the motion and nothing else."""
    parts = []
    for states, name in _STATES.items():
        some = table[table["test"] == "held-out"] if len(table) else table
        some = some[some["states"] == states] if len(some) else some
        if not len(some):
            continue
        middle = some.groupby(["model", "flight"])["long"].median()
        shares = [
            f"{number((middle['mean flight'] / middle[model]).median())} times that of {model}"
            for model in ("T", "T (ours)")
        ]
        parts.append(f"{name}: {' and '.join(shares)}")
    if not parts:
        return ""
    told = "; ".join(parts)
    return f"The error of the mean flight at the same time, which looks at no state, is, {told}."


def _comparisons(table: pd.DataFrame, test: str) -> list[Comparison]:
    if not len(table):
        return []
    comparisons = []
    for states, name in _STATES.items():
        some = table[(table["states"] == states) & (table["test"] == test)]
        middle = some.groupby(["model", "flight", "seed"])["long"].median()
        for how, mark in (("paper's settings", ""), ("tuned (our defaults)", " (ours)")):
            for rival in _RIVALS:
                if {rival + mark, "T" + mark} <= set(some["model"]):
                    a, b = middle[rival + mark].align(middle["T" + mark], join="inner")
                    comparisons.append(
                        compare_seeds(
                            a.to_numpy(),
                            b.to_numpy(),
                            condition=f"{name}, {how}, logged actions",
                            what=f"{rival} / T",
                        )
                    )
    return comparisons
