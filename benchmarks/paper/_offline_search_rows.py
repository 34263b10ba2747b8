"""Rows of the offline search, and those that score gains without a forecast of states."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.pipeline import Pipeline

from benchmarks.paper._flights_kernel import gain_scaler
from benchmarks.paper._flights_ranking import nearest, pooled_gp, with_target
from benchmarks.paper._offline_search_data import Pool

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

#: Rows of `_flights_models.build`, which forecast states.
T, NO_GAINS, C = "T, tracking error", "T, tracking error, no gains", "C"
MEAN, RIDGE = "mean flight", "kernel ridge"
#: Rows that go from gains, or from the number of the experiment, to a score.
GP, BEST_GAINS, IN_TIME = "direct GP", "near the best gains", "nearest in time"
LCB, FAR, CHANCE = f"{GP}, LCB", "far from what was tried", "random"
NO_FORECAST = (GP, LCB, BEST_GAINS, IN_TIME, FAR, CHANCE)
#: Of the standard deviation, in the lower confidence bound.
KAPPA = 1.0


def from_gains(row: str, candidates: Pool, known: Ints, asked: Ints, seed: int) -> Floats:
    """What a row of `NO_FORECAST` that knows some experiments expects of others: less is better.

    A tracking error [m], or a score in another unit; infinite where a row knows nothing.
    """
    if row == CHANCE:
        return np.zeros(len(asked))
    if row == BEST_GAINS:
        return from_the_best(candidates, known, asked)
    if row == FAR:
        return from_all(candidates, known, asked)
    flights = candidates.flights_of(known)
    first = candidates.table["first"].to_numpy()[asked]
    if row == IN_TIME:
        found = [nearest(candidates.every, flights, i, candidates.errors) for i in first]
        return np.nan_to_num(np.array(found), nan=np.inf)
    return direct_gp(candidates, flights, first, seed)[row == LCB]


def direct_gp(candidates: Pool, known: Ints, asked: Ints, seed: int) -> tuple[Floats, Floats]:
    """Tracking errors [m] of flights, and their lower confidence bound, by the direct GP.

    It learns the logarithm of the error, from gains and kind of flight alone.
    """
    ds, log_error = candidates.every.ds, np.log(candidates.errors)
    model = pooled_gp(seed).fit(with_target(ds[known], log_error[known]))
    mean, std = model.predict(ds[asked], return_std=True)
    return np.exp(mean), np.exp(mean - KAPPA * std)


def from_the_best(candidates: Pool, known: Ints, experiments: Ints) -> Floats:
    """Distance of gains from those of the best known experiment of the same group.

    Gains on a logarithmic scale, standardised over the known experiments of the group; infinite
    where the group has none.
    """
    result = np.full(len(experiments), np.inf)
    group = candidates.table["group"].to_numpy()
    for name in np.unique(group[experiments]):
        own, mine = known[group[known] == name], group[experiments] == name
        if len(own):
            scaler: Pipeline = gain_scaler().fit(candidates.gains(own))
            best = candidates.gains(own[[candidates.flown[own].argmin()]])
            asked = scaler.transform(candidates.gains(experiments[mine]))
            result[mine] = np.linalg.norm(asked - scaler.transform(best), axis=1)
    return result


def from_all(candidates: Pool, known: Ints, experiments: Ints) -> Floats:
    """Minus the distance of gains from the nearest known experiment; all of one group.

    Gains on a logarithmic scale, standardised over the known and the asked ones.
    """
    near, far = candidates.gains(known), candidates.gains(experiments)
    scaler: Pipeline = gain_scaler().fit(np.concatenate([near, far]))
    return -cdist(scaler.transform(far), scaler.transform(near)).min(axis=1)
