"""Scores of a predictive distribution: a Gaussian about 0, or a sample sorted along axis 0."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

__all__ = [
    "STD_FLOOR",
    "gaussian_crps",
    "gaussian_nll",
    "gaussian_pit",
    "sample_crps",
    "sample_energy",
    "sample_level",
    "sample_nll",
    "sample_pit",
    "sample_std",
    "sample_width",
]

Floats = NDArray[np.float64]

# training ranges; a narrower Gaussian counts as this wide where a density is asked for
STD_FLOOR = 1e-6


def gaussian_pit(y: Floats, std: Floats) -> Floats:
    """Probability below `y`; one half where a point forecast is exact."""
    return np.where((y == 0) & (std == 0), 0.5, ndtr(y / std))


def gaussian_crps(y: Floats, std: Floats) -> Floats:
    """CRPS; the absolute error where `std` is 0."""
    from scoringrules import crps_normal

    return np.where(std > 0, crps_normal(y, 0.0, std, backend="numpy"), np.abs(y))


def gaussian_nll(y: Floats, std: Floats) -> Floats:
    """Negative logarithm of the density."""
    # scoringrules takes the logarithm of a density that is 0 beyond 38 std
    width = np.maximum(std, STD_FLOOR)
    return np.log(width) + 0.5 * np.log(2 * np.pi) + (y / width) ** 2 / 2


def sample_pit(x: Floats, y: Floats) -> Floats:
    """Middle of the slot of `y` among the sample, of which there are one more than samples."""
    rank = ((x < y).sum(axis=0) + (x <= y).sum(axis=0)) / 2
    return (rank + 0.5) / (len(x) + 1)


def sample_crps(x: Floats, y: Floats) -> Floats:
    """Fair CRPS: unbiased whatever the number of samples, hence below 0 at times."""
    from scoringrules import crps_ensemble

    # "pwm" is the fair estimator in O(S) for a sorted sample
    score = crps_ensemble(y, x, 0, estimator="pwm", sorted_ensemble=True, backend="numpy")
    return np.where(np.isfinite(x).all(axis=0), score, np.inf)


def sample_std(x: Floats, y: Floats) -> Floats:
    """Standard deviation of the sample."""
    return np.where(np.isfinite(x).all(axis=0), x.std(axis=0, ddof=1), np.inf)


def sample_nll(x: Floats, y: Floats) -> Floats:
    """Negative logarithm of the Gaussian density with the moments of the sample."""
    score = gaussian_nll(y - x.mean(axis=0), sample_std(x, y))
    return np.where(np.isfinite(x).all(axis=0), score, np.inf)


def sample_level(x: Floats, y: Floats) -> Floats:
    """Least level whose central interval contains `y`; inf where none does."""
    above = _position(x, y, (x <= y).sum(axis=0))
    below = _position(x, y, (x < y).sum(axis=0))
    level = np.maximum(np.maximum(1 - 2 * above, 2 * below - 1), 0.0)
    return np.where((y < x[0]) | (y > x[-1]), np.inf, level)


def _position(x: Floats, y: Floats, count: NDArray[np.intp]) -> Floats:
    """Probability at which linear interpolation of the sample reaches `y`, after `count` of it."""
    last = len(x) - 1
    before, after = np.clip(count - 1, 0, last), np.clip(count, 0, last)
    left, right = (np.take_along_axis(x, i[None], axis=0)[0] for i in (before, after))
    part = np.where(right > left, (y - left) / (right - left), 0.0)
    position: Floats = (before + 1 + part) / (last + 2)
    return position


def sample_width(x: Floats, y: Floats, *, level: float) -> Floats:
    """Width of the central interval, as of `Forecast.interval`."""
    lower, upper = (_quantile(x, q) for q in ((1 - level) / 2, (1 + level) / 2))
    return np.where(np.isfinite(upper), upper - lower, np.inf)


def _quantile(x: Floats, q: float) -> Floats:
    below, weight = divmod(min(max(q * (len(x) + 1) - 1, 0), len(x) - 1), 1)
    at: Floats = x[int(below)]
    return at + weight * (x[int(below) + 1] - at) if weight else at


def sample_energy(x: Floats, y: Floats) -> Floats:
    """Fair energy score of the joint sample (S, ..., k) at `y` (..., k)."""
    from scipy.spatial.distance import pdist

    error = np.linalg.norm(x - y, axis=-1).mean(axis=0)
    # a cell at a time: the distances of all pairs in all cells would not fit in memory
    cells = np.moveaxis(x, 0, -2).reshape(-1, len(x), x.shape[-1])
    spread = np.array([pdist(cell).mean() for cell in cells]).reshape(error.shape)
    return np.where(np.isfinite(x).all(axis=(0, -1)), error - spread / 2, np.inf)
