"""Statistics over episodes in which NaN is absent and +inf an ordinary, largest value."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["mean", "mean_by", "quantile"]

Floats = NDArray[np.float64]


def mean(values: Floats) -> Floats:
    """Mean over the first axis; NaN where nothing is present."""
    present = ~np.isnan(values)
    total, count = np.where(present, values, 0.0).sum(axis=0), present.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_by(values: Floats, labels: NDArray[np.intp]) -> Floats:
    """Mean over the rows of each label (number of labels, ...), in increasing order of label."""
    order = np.argsort(labels, kind="stable")
    _, first = np.unique(labels[order], return_index=True)
    ordered = values[order]
    present = ~np.isnan(ordered)
    total = np.add.reduceat(np.where(present, ordered, 0.0), first, axis=0)
    count = np.add.reduceat(present.astype(np.intp), first, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def quantile(values: Floats, q: float) -> Floats:
    """Linear quantile over the first axis."""
    ordered = np.sort(values, axis=0)  # NaN last, after inf
    count = (~np.isnan(values)).sum(axis=0)
    position = q * np.maximum(count - 1, 0)
    below = np.floor(position).astype(np.intp)
    weight = position - below
    low = np.take_along_axis(ordered, below[None], axis=0)[0]
    high = np.take_along_axis(ordered, (below + (weight > 0))[None], axis=0)[0]
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(high), low + weight * (high - low), high)
