"""Claims about time: what a forecast costs, and times that no log has."""

import numpy as np
import pandas as pd

from benchmarks.paper._claims import Claim, Comparison, Sources, compare_seeds
from benchmarks.paper.continuous_time import lost_between

#: One-step models of an uneven or thinned log that are asked between its times, as a rival of T.
_RIVALS = {
    "irregular": {
        "C with the time step": ("C with dt (ours)", "none", "long steps"),
        "D with the time step, recomputed": ("D with dt (ours)", "policy", "long steps"),
    },
    "regular": {
        "C, straight lines between steps": ("C (ours)", "none", "linear"),
        "D, recomputed, straight lines between steps": ("D (ours)", "policy", "linear"),
    },
}
_T_ASKED = ("T (ours)", "none", "direct")


def planning(sources: Sources) -> Claim:
    seconds = sources["audit"]["planning"]
    by_way = seconds.set_index(["way", "candidates", "seed"])["seconds"].sort_index()
    return Claim(
        "Planning is cheaper with one evaluation than with a roll-out",
        "Evaluating all horizons at once spares the sequential steps of a roll-out and can "
        "raise the rate of planning dramatically.",
        [
            compare_seeds(
                by_way.loc["one-step", n].to_numpy(),
                by_way.loc[way, n].to_numpy(),
                condition=f"candidates: {n}, {way.partition(', ')[2] or 'every horizon'}",
                what="seconds of one-step / seconds of T",
            )
            for n in seconds["candidates"].unique()
            for way in ("T", "T, every 10th horizon")
        ],
        notes=[
            "Bare networks of the same size in plain torch on one CPU thread, 200 steps; this "
            "library's overhead is not in these numbers (see benchmarks/speed)."
        ],
    )


def continuous_time(sources: Sources) -> Claim:
    comparisons = []
    for where, asked, places in _conditions_in_time(sources):
        lost = lost_between(places, "T (ours)")
        comparisons.append(
            Comparison(
                f"{where}: between the times of a regular log",
                "T off the grid / on it",
                lost.middle,
                np.nan,
                np.nan,
                (lost.low, lost.high),
                same=True,
            )
        )
        comparisons.append(
            compare_seeds(
                *(_every_step(asked, (log, *_T_ASKED)) for log in ("irregular", "regular")),
                condition=f"{where}: learning from irregular times",
                what="T of the irregular log / of the regular one",
                same=True,
            )
        )
    return Claim(
        "Trajectory models work in continuous time",
        "T is agnostic to discrete or continuous time: it can learn from data at any horizon and "
        "interpolate between them. (Not tested in the paper.)",
        comparisons,
        notes=[
            "Tuned models (our defaults). Errors between the times of a log are set against those "
            "on them, corrected for the times."
        ],
        figure="continuous-time/continuous-time.png",
    )


def duels_in_time(sources: Sources) -> Claim:
    return Claim(
        "Trajectory models beat one-step models between the times of a log",
        "Not claimed, but what the claim before invites to believe.",
        [
            compare_seeds(
                _every_step(asked, (log, *rival)),
                _every_step(asked, (log, *_T_ASKED)),
                condition=f"{where}, {log} log, against {name}",
                what=f"{name.split(',')[0]} / T",
            )
            for where, asked, _ in _conditions_in_time(sources)
            for log, rivals in _RIVALS.items()
            for name, rival in rivals.items()
        ],
        notes=["Tuned models (our defaults) of the same log, asked for every control step."],
    )


def _conditions_in_time(sources: Sources) -> list[tuple[str, pd.DataFrame, pd.DataFrame]]:
    """Name, errors by what was asked, and errors by distance from the grid."""
    tables = sources["continuous-time"]
    keys = ["task", "interval"]
    places = dict(iter(tables["distances"].groupby(keys, sort=False)))
    return [
        (f"{key[0]}, a state every {key[1]:g} s", asked, places[key])
        for key, asked in tables["asked"].groupby(keys, sort=False)
    ]


def _every_step(asked: pd.DataFrame, line: tuple[str, str, str, str]) -> np.ndarray:
    """Error of a model at every control step, by seed."""
    some = asked[asked["asked"] == "every step"]
    by_line = some.set_index(["log", "model", "actions", "way", "seed"])["median"].sort_index()
    return by_line.loc[line].to_numpy()
