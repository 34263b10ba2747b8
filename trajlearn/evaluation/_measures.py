"""Measures of calibration by horizon bin and state, resampled over episodes."""

import warnings
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from trajlearn.evaluation._bootstrap import EpisodeBootstrap
from trajlearn.evaluation._cells import Cells
from trajlearn.exceptions import CalibrationWarning

__all__ = ["LEVELS", "Measures"]

Floats = NDArray[np.float64]

# nominal levels over which calibration error and reliability go
LEVELS = tuple(float(level) for level in np.round(np.arange(0.05, 0.951, 0.05), 2))


class Measures:
    """Statistics (1 + n_bootstrap, n_bins, k + 1); the last column pools the k states."""

    def __init__(self, cells: Cells, bootstrap: EpisodeBootstrap, distribution: str) -> None:
        self._cells, self._bootstrap, self._distribution = cells, bootstrap, distribution
        present = bootstrap.by_episode(cells.present.astype(np.float64))
        diverged = bootstrap.by_episode(cells.diverged.astype(np.float64))
        self.n_episodes = (present > 0).sum(axis=0)
        self.n_diverged = (diverged > 0).sum(axis=0)
        self._count = bootstrap.resampled(present)

    def mean(self, values: Floats) -> Floats:
        """Mean of cells (n, H, k), or of those of the joint state (n, H)."""
        total = self._bootstrap.totals(values)
        return _ratio(total, self._count if values.ndim == 3 else self._count[..., :1])

    def coverage(self, levels: Sequence[float]) -> Iterator[Floats]:
        """Share of logged states inside the interval of each level."""
        return map(self.mean, self._cells.hits(levels))

    def widths(self, levels: Sequence[float]) -> Iterator[Floats]:
        """Mean width of the interval of each level."""
        for level in levels:
            yield self.mean(_quietly(self._cells.widths, level))

    def crps(self) -> Floats:
        """Mean CRPS."""
        return self.mean(self._cells.crps(self._distribution))

    def nll(self) -> Floats:
        """Mean negative log likelihood."""
        return self.mean(self._cells.nll(self._distribution))

    def energy(self) -> Floats:
        """Mean energy score, of the joint state."""
        return self.mean(self._cells.energy())

    def calibration_error(self) -> Floats:
        """Mean distance between coverage and level over `LEVELS`."""
        gap: Floats = np.zeros(())
        for level in LEVELS:
            gap = gap + np.abs(self.mean(_quietly(self._cells.hits, level)) - level)
        return gap / len(LEVELS)

    def spread_skill(self, spread: Floats) -> Floats:
        """Root mean variance over root mean squared error; 0 where a cell has diverged."""
        variance = self.mean(spread**2)
        error = self.mean(self._cells.errors**2)
        with np.errstate(invalid="ignore"):
            return np.where(np.isinf(error), 0.0, np.sqrt(_ratio(variance, error)))

    def correlation(self, spread: Floats) -> Floats:
        """Rank correlation of absolute error and spread over the cells that have not diverged.

        Ranks are those among all episodes, also in a resample of them.
        """
        errors = np.abs(self._cells.errors)
        columns = [b.columns for b in self._bootstrap.bins]
        return np.stack([self._correlation(errors[:, c], spread[:, c]) for c in columns], axis=1)

    def _correlation(self, errors: Floats, spread: Floats) -> Floats:
        settled = ~np.isnan(spread)
        kept = settled[..., 0]
        x, y = np.zeros((2, *errors.shape)), np.zeros((2, *errors.shape))
        for ranks, values in ((x, errors), (y, spread)):
            ranks[0, kept] = _centred_ranks(values[kept], axis=0)
            ranks[1, kept] = _centred_ranks(values[kept], axis=None)
        one = settled.astype(np.float64)
        moments = []
        for product in (one, x, y, x * x, y * y, x * y):
            own, pooled = product if product.ndim == 4 else (product, product)
            own, pooled = own.sum(axis=1), pooled.sum(axis=(1, 2))
            moments.append(np.column_stack([own, pooled]))
        sums = self._bootstrap.joined(np.stack(moments, axis=1))
        n, sx, sy, sxx, syy, sxy = np.moveaxis(self._bootstrap.resampled(sums), 1, 0)
        spreads = (n * sxx - sx**2, n * syy - sy**2)
        # rounding alone is no spread
        of_x, of_y = (np.where(spread > 1e-12 * n**2, spread, 0.0) for spread in spreads)
        return _ratio(n * sxy - sx * sy, np.sqrt(of_x * of_y))

    def pit_shares(self, n_bins: int) -> Iterator[Floats]:
        """Share of the logged states in each of `n_bins` equal parts of [0, 1] of the PIT.

        A logged state among samples has a slot of them, which counts for each part that it
        overlaps.
        """
        pit = self._cells.pit(self._distribution)
        width = self._cells.slot(self._distribution)
        diverged = self._cells.diverged
        below = np.zeros(())
        for edge in np.arange(1, n_bins + 1) / n_bins:
            if edge == 1:
                inside = np.ones_like(pit)
            elif width:
                inside = np.clip((edge - pit) / width + 0.5, 0.0, 1.0)
            else:
                inside = (pit < edge).astype(np.float64)
            inside[diverged] = 0.0
            inside[~self._cells.present] = np.nan
            reached = self.mean(inside)
            yield reached - below
            below = reached


def _quietly(values: Callable[[Sequence[float]], Iterator[Floats]], level: float) -> Floats:
    """Values of one level, without a word on bands of a level that nobody asked for (again)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return next(values([level]))


def _ratio(part: Floats, whole: Floats) -> Floats:
    """NaN where the whole is 0, also if the part is not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(whole > 0, part / whole, np.nan)


def _centred_ranks(values: Floats, axis: int | None) -> Floats:
    """Ranks about 0, at most one half away from it."""
    if not values.size:
        return values
    ranks = rankdata(values, axis=axis).reshape(values.shape)
    n = values.size if axis is None else len(values)
    return (ranks - (n + 1) / 2) / n
