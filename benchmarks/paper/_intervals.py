"""How sure a comparison of two models is: ratios of median errors with bootstrap intervals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

_LEVEL = 0.95
_N_RESAMPLES = 2000

Floats = NDArray[np.float64]


class Ratio(NamedTuple):
    """Ratio of median errors, and the interval around it."""

    estimate: float
    low: float
    high: float


def ratio(
    episodes_a: Sequence[ArrayLike], episodes_b: Sequence[ArrayLike], *, random_state: int = 0
) -> Ratio:
    """Ratio a / b of median errors over test episodes, with a paired bootstrap interval.

    The statistic is the one that the tables print: the median over episodes for each seed, then
    the median over seeds, of a and of b. Resampling draws episodes with replacement within each
    seed, the same ones for a and b, so that what is hard for both cancels. The interval holds
    the middle 95 % of the resampled ratios; it is the same for the ratio as for its logarithm.

    It tells how much the test episodes matter, for the models as they were trained. Three seeds
    are too few to resample: print the spread over seeds beside it (`ratio_of_each_seed`).

    Parameters
    ----------
    episodes_a, episodes_b : sequence of array-like of shape (n_episodes,)
        Errors of the episodes, one array a seed, in the same order in a and b. At least 0;
        infinite where a forecast diverged.
    random_state : int

    Returns
    -------
    Ratio
        Infinite if only the median of a is, 0 if only that of b is, NaN if both are or both are
        0. A resample whose ratio is NaN tells nothing: it counts as 0 for `low` and as infinite
        for `high`.

    Raises
    ------
    ValueError
        If the shapes differ, or an error is negative or NaN.
    """
    pairs = _paired(episodes_a, episodes_b)
    rng = np.random.default_rng(random_state)
    medians: list[Floats] = []
    for pair in pairs:
        n = pair.shape[1]
        drawn = rng.integers(n, size=(_N_RESAMPLES, n))
        medians.append(np.median(pair[:, drawn], axis=2))
    resampled = _divide(*np.median(medians, axis=0))
    unknown = np.isnan(resampled)
    tail = (1 - _LEVEL) / 2
    # one of the ratios, because interpolating between infinite ones would give NaN
    low = np.quantile(np.where(unknown, 0.0, resampled), tail, method="inverted_cdf")
    high = np.quantile(np.where(unknown, np.inf, resampled), 1 - tail, method="inverted_cdf")
    middle = np.median([np.median(pair, axis=1) for pair in pairs], axis=0)
    return Ratio(float(_divide(*middle)), float(low), float(high))


def ratio_of_each_seed(
    episodes_a: Sequence[ArrayLike], episodes_b: Sequence[ArrayLike]
) -> list[float]:
    """Ratio a / b of the medians over episodes, seed by seed; arguments as of `ratio`."""
    pairs = _paired(episodes_a, episodes_b)
    return [float(_divide(*np.median(pair, axis=1))) for pair in pairs]


def by_seed(table: pd.DataFrame, column: str) -> list[Floats]:
    """A column of a table of episodes as `ratio` takes it: an array a seed, in order."""
    ordered = table.sort_values(["seed", "episode"])
    if ordered.duplicated(["seed", "episode"]).any():
        raise ValueError(
            "the table has an episode of a seed more than once: choose one model and one source "
            "of actions first."
        )
    return [some[column].to_numpy(dtype=np.float64) for _, some in ordered.groupby("seed")]


def spread(values: ArrayLike, how: str | None = None) -> str:
    """Median of a number over seeds, and its least and greatest value, as the tables print it.

    `how` is a format such as ".2f"; None: two significant digits.
    """
    some = np.asarray(values, dtype=np.float64)
    middle, low, high = (
        rounded(value) if how is None else format(value, how)
        for value in (np.median(some), some.min(), some.max())
    )
    return middle if len(some) == 1 else f"{middle} ({low} to {high})"


def rounded(value: float, digits: int = 2) -> str:
    """A number to so many significant digits, below a million without an exponent."""
    return f"{float(f'{value:.{digits}g}'):g}"


def _paired(a: Sequence[ArrayLike], b: Sequence[ArrayLike]) -> list[Floats]:
    """Arrays (2, n_episodes), one a seed."""
    first, second = ([np.asarray(some, dtype=np.float64) for some in both] for both in (a, b))
    shapes = [some.shape for some in first], [some.shape for some in second]
    if shapes[0] != shapes[1] or not shapes[0] or any(len(s) != 1 or not s[0] for s in shapes[0]):
        raise ValueError(
            f"the errors have the shapes {shapes[0]} and {shapes[1]}: give one array of episodes "
            "a seed, the same episodes for both."
        )
    pairs = [np.stack(pair) for pair in zip(first, second, strict=True)]
    if not all((pair >= 0).all() for pair in pairs):
        raise ValueError("errors must be at least 0, and infinite, not NaN, after a divergence.")
    return pairs


def _divide(a: Floats, b: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(a, b)
