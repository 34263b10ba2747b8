"""Held-out experiments ranked by models that know the others, and what the choice is worth."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_models import build
from benchmarks.paper._offline_search_data import (
    EARLY,
    FIFTH,
    LATE,
    RANDOM,
    SPLITS,
    Pool,
    distinct_gains,
    held_out,
    n_folds,
    noise,
    pool,
    predicted_before,
    predicted_from_own_start,
)
from benchmarks.paper._offline_search_rows import (
    BEST_GAINS,
    GP,
    IN_TIME,
    MEAN,
    NO_FORECAST,
    NO_GAINS,
    RIDGE,
    C,
    T,
    from_gains,
)
from trajlearn import rank_correlation

Floats = NDArray[np.float64]

#: Rows of one cell; those of the first do not depend on a seed.
CELLS = [[MEAN, RIDGE, GP, BEST_GAINS, IN_TIME], [T], [NO_GAINS], [C]]
#: Rows that are shown from the start that was flown as well.
FROM_OWN_START = (T, NO_GAINS, C)
#: How a forecast begins: at the usual start, or at the one that the flight really had.
USUAL, OWN = "usual", "own"
FLOWN = "flown"
#: Rows whose taste in gains is looked at.
TASTES = (FLOWN, T, RIDGE, GP)
TOP = 3


def cells(mode: str, seeds: list[int]) -> list[dict[str, Any]]:
    """What is asked of `cell`: as many random halves as seeds, up to three seeds of networks.

    T without gains can only tell flights apart by their start: a few splits show what that is.
    """
    asked = []
    for split in SPLITS if mode == "full" else (RANDOM, LATE):
        for fold in seeds if split == RANDOM else range(n_folds(split)):
            for rows in CELLS:
                varied = split in (LATE, EARLY) and rows[0] in (T, C)
                if rows == [NO_GAINS] and (split == FIFTH or fold > 2):
                    continue
                own = [fold] if split == RANDOM else seeds[: 3 if varied else 1]
                asked += [
                    {"rows": rows, "split": split, "fold": fold, "mode": mode, "seed": seed}
                    for seed in own
                ]
    return asked


def cell(rows: list[str], split: str, fold: int, mode: str, seed: int) -> dict[str, Any]:
    """Tracking errors [m] (or another score, less is better) of the held-out experiments.

    Returns
    -------
    dict
        ``experiments``: their numbers; ``rows``: of each row scores by start, `USUAL` or `OWN`.
    """
    candidates = pool()
    train, test = held_out(candidates, split, fold)
    scores: dict[str, dict[str, Floats]] = {}
    for row in rows:
        if row in NO_FORECAST:
            scores[row] = {USUAL: from_gains(row, candidates, train, test, seed)}
            continue
        known = candidates.flights_of(train)
        model = build(row, mode, seed).fit(candidates.every.ds[known])
        scores[row] = {USUAL: predicted_before(model, candidates, known, test)}
        if row in FROM_OWN_START:
            scores[row][OWN] = predicted_from_own_start(model, candidates, test)
    return {"experiments": test, "rows": scores}


# -- what a choice is worth ------------------------------------------------------------------


def choice(predicted: Floats, flown: Floats) -> dict[str, float]:
    """Rank correlation, and what is flown with the experiments of the least predictions.

    Experiments with the same prediction are as good as drawn at random: each counts with their
    mean. Choosing at random therefore gives the mean of all.

    Returns
    -------
    dict
        ``rho``, NaN where all predictions are equal; ``chosen``: flown error of the first choice;
        ``top``: mean of the first three; ``best`` and ``best_top``: least possible; ``random``:
        expected of both at random; ``median`` and ``n`` of all.
    """
    ties = np.unique(predicted, return_inverse=True)[1]
    expected = (np.bincount(ties, weights=flown) / np.bincount(ties))[ties]
    order = expected[np.argsort(predicted, kind="stable")]
    best = np.sort(flown)
    found = rank_correlation(predicted, flown, n_bootstrap=0)
    return {
        "rho": found["pooled"],
        "chosen": order[0],
        "top": order[:TOP].mean(),
        "best": best[0],
        "best_top": best[:TOP].mean(),
        "random": flown.mean(),
        "median": np.median(flown),
        "n": len(flown),
    }


def choice_table(candidates: Pool, done: list[tuple[dict[str, Any], Any]]) -> pd.DataFrame:
    """A line a split, fold, seed, group, row and start: `choice`, errors in mm."""
    lines = []
    for asked, result in done:
        test = np.array(result["experiments"])
        flown, group = 1e3 * candidates.flown[test], candidates.table["group"].to_numpy()[test]
        head = {key: asked[key] for key in ("split", "fold", "seed")}
        for row, scores in result["rows"].items():
            for start, score in scores.items():
                for name in np.unique(group):
                    mine = group == name
                    line = head | {"group": name, "row": row, "start": start}
                    lines.append(line | choice(np.array(score)[mine], flown[mine]))
    return pd.DataFrame(lines)


def score_table(candidates: Pool, done: list[tuple[dict[str, Any], Any]]) -> pd.DataFrame:
    """Predicted and flown error [mm] of each held-out experiment of two splits, for the eye."""
    lines = []
    for asked, result in done:
        if asked["split"] not in (RANDOM, LATE) or asked["fold"] or asked["seed"]:
            continue
        test = candidates.table.iloc[result["experiments"]]
        for row, scores in result["rows"].items():
            if row in TASTES:
                head = {"split": asked["split"], "row": row, "group": test["group"]}
                columns = {"experiment": test["experiment"], "flown": 1e3 * test["flown"]}
                predicted = 1e3 * np.array(scores[USUAL], dtype=float)
                lines.append(pd.DataFrame(head | columns | {"predicted": predicted}))
    return pd.concat(lines, ignore_index=True)


def gain_table(candidates: Pool, done: list[tuple[dict[str, Any], Any]]) -> pd.DataFrame:
    """What flown and predicted errors say of each gain, over the held-out experiments.

    ``rho``: rank correlation of the gain with the error (below 0: more is better); ``top``: mean
    of the gain over the three experiments of the least error; ``usual``: median over all; ``n`` and
    ``n_known``: how many values it has among the held-out and among the training experiments.
    """
    lines = []
    for asked, result in done:
        if asked["split"] not in (RANDOM, LATE):
            continue
        test = np.array(result["experiments"])
        scores = {row: np.array(found[USUAL]) for row, found in result["rows"].items()}
        if RIDGE in scores:
            scores[FLOWN] = candidates.flown[test]
        for group in candidates.table["group"].unique():
            every = candidates.of_group(group)
            asked_of, place = np.isin(test, every), np.isin(every, test)
            for gain, values in distinct_gains(candidates, group).items():
                own, n_known = values[place], len(np.unique(values[~place]))
                for row in [row for row in TASTES if row in scores]:
                    error = scores[row][asked_of]
                    line = {key: asked[key] for key in ("split", "fold", "seed")}
                    line |= {"group": group, "row": row, "gain": gain}
                    line["rho"] = rank_correlation(error, own, n_bootstrap=0)["pooled"]
                    line["top"] = own[np.argsort(error, kind="stable")[:TOP]].mean()
                    line |= {"usual": np.median(own), "n": len(np.unique(own))}
                    lines.append(line | {"n_known": n_known})
    by, columns = ["split", "group", "row", "gain"], ["rho", "top", "usual", "n", "n_known"]
    # over folds and seeds: one of them says little
    table = pd.DataFrame(lines).groupby(by, sort=True)[columns].mean()
    return table.reset_index()


def pool_table(candidates: Pool) -> pd.DataFrame:
    """A line a group: how many experiments, their flown errors [mm], and noise between repeats."""
    lines = []
    for group in np.unique(candidates.every.group):
        mine = candidates.every.group == group
        flown = 1e3 * candidates.flown[candidates.of_group(group)]
        std, free, guess = noise(candidates, group)
        known = np.isfinite(guess)
        rho = float("nan")
        if known.sum() > 2:
            errors = candidates.errors[mine][known]
            rho = rank_correlation(guess[known], errors, n_bootstrap=0)["pooled"]
        line = {"group": group, "n": len(flown), "n_flights": int(mine.sum())}
        line |= {"best": flown.min(), "median": np.median(flown), "worst": flown.max()}
        line |= {"repeat_std": 1e3 * std, "n_repeats": free, "repeat_rho": rho}
        lines.append(line)
    return pd.DataFrame(lines)
