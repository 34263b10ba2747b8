"""Sums over cells by horizon bin and state, of all episodes and of resampled ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_random_state

from trajlearn.evaluation._statistics import quantile

__all__ = ["Bin", "EpisodeBootstrap", "bounds", "horizon_bins"]

Floats = NDArray[np.float64]

_STANDARD = ((1, 5), (6, 25), (26, 75), (76, 150), (151, np.inf))


@dataclass(frozen=True)
class Bin:
    """Horizons from `first` to `last` steps, and their columns in the forecast."""

    first: int
    last: int
    columns: slice


def horizon_bins(
    horizons: NDArray[np.intp], bins: str | Sequence[tuple[int, int]] | None
) -> list[Bin]:
    """Bins of the horizons of a forecast: the standard ones, given ones, or each horizon.

    Raises
    ------
    ValueError
        If `bins` is none of these, or a given one has no horizon inside.
    """
    if bins is None:
        return [Bin(int(h), int(h), slice(j, j + 1)) for j, h in enumerate(horizons)]
    standard = isinstance(bins, str)
    if bins == "standard":
        asked: Sequence[tuple[float, float]] = _STANDARD
    elif isinstance(bins, str) or not len(bins) or any(np.shape(b) != (2,) for b in bins):
        raise ValueError(
            f'bins = {bins!r} must be "standard", None for every horizon, or a list of (first, '
            "last) horizons in steps, both inside."
        )
    else:
        asked = bins
    found = []
    for first, last in asked:
        left = int(np.searchsorted(horizons, first))
        right = int(np.searchsorted(horizons, last, side="right"))
        if left < right:
            end = min(last, horizons[-1]) if standard else last
            found.append(Bin(int(first), int(end), slice(left, right)))
        elif not standard:
            raise ValueError(
                f"bins: there is no horizon from {first} to {last} in the forecast, which has "
                f"{horizons[0]}..{horizons[-1]}."
            )
    return found


class EpisodeBootstrap:
    """Totals over whole episodes: entry 0 of all of them, the others of resamples.

    Parameters
    ----------
    episode : ndarray of shape (n,)
        Episode of each forecast.
    bins : list of Bin
    n_bootstrap : int
    random_state : int, RandomState or None
    """

    def __init__(
        self,
        episode: NDArray[np.intp],
        bins: Sequence[Bin],
        n_bootstrap: int,
        random_state: int | np.random.RandomState | None,
    ) -> None:
        self.bins = bins
        known, self._label = np.unique(episode, return_inverse=True)
        self.n_episodes = len(known)
        rng = check_random_state(random_state)
        share = np.full(self.n_episodes, 1 / self.n_episodes)
        drawn = rng.multinomial(self.n_episodes, share, size=n_bootstrap)
        self._weights = np.concatenate([np.ones((1, self.n_episodes)), drawn])

    def by_episode(self, values: Floats) -> Floats:
        """Sums (n_episodes, n_bins, k + 1) of cells (n, H, k); the last column is of all states.

        NaN is absent. Cells (n, H) of the joint state give one column.
        """
        cells = values if values.ndim == 3 else values[..., None]
        cells = np.where(np.isnan(cells), 0.0, cells)
        sums = np.stack([cells[:, b.columns].sum(axis=1) for b in self.bins], axis=1)
        if values.ndim == 3:
            sums = np.concatenate([sums, sums.sum(axis=2, keepdims=True)], axis=2)
        return self.joined(sums)

    def joined(self, sums: Floats) -> Floats:
        """Sums (n, ...) of the forecasts of each episode (n_episodes, ...)."""
        total = np.zeros((self.n_episodes, *sums.shape[1:]))
        np.add.at(total, self._label, sums)
        return total

    def resampled(self, sums: Floats) -> Floats:
        """Totals (1 + n_bootstrap, ...) of sums (n_episodes, ...); inf where one drawn is."""
        flat = sums.reshape(self.n_episodes, -1)
        infinite = np.isinf(flat)
        total = self._weights @ np.where(infinite, 0.0, flat)
        affected = infinite.any(axis=0)
        total[:, affected] += np.where(self._weights @ infinite[:, affected] > 0, np.inf, 0.0)
        return total.reshape(-1, *sums.shape[1:])

    def totals(self, values: Floats) -> Floats:
        """Totals (1 + n_bootstrap, n_bins, k + 1) of cells (n, H, k)."""
        return self.resampled(self.by_episode(values))


def bounds(statistic: Floats, confidence: float) -> tuple[Floats, Floats]:
    """Percentile interval of a statistic (1 + n_bootstrap, ...); NaN without resamples."""
    drawn = statistic[1:]
    if not len(drawn):
        nothing = np.full(statistic.shape[1:], np.nan)
        return nothing, nothing
    tail = (1 - confidence) / 2
    return quantile(drawn, tail), quantile(drawn, 1 - tail)
