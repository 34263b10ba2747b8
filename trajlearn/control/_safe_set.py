"""Candidates that are likely enough to keep a constraint."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["best_to_worst", "ranked"]

Floats = NDArray[np.float64]


def ranked(value: Floats, violation: Floats, limit: float, scale: float) -> Floats:
    """Values in their order, and below them all that violate too much, by how much they do.

    So an optimiser that begins where all violates is led to where less does, whatever the values
    are there.

    Parameters
    ----------
    value, violation : ndarray of shape (m,)
    limit : float
        Greatest violation that is none.
    scale : float
        Typical size of values.

    Returns
    -------
    ndarray of shape (m,)
        From -1 to 1, and from -2 to -1 beyond the limit.
    """
    with np.errstate(invalid="ignore"):
        squashed = value / (scale + np.abs(value))
    squashed = np.where(np.isfinite(value), squashed, -1.0)
    return np.where(violation <= limit, squashed, -1.0 - violation)


def best_to_worst(batches: Sequence[tuple[Floats, Floats]], n: int) -> tuple[Floats, Floats]:
    """About n of the candidates of all batches, densely at the best, thinly down to the worst.

    The greatest value that keeps a constraint in some samples is likely to owe it to them, so
    others stand by when it is judged again.

    Parameters
    ----------
    batches : sequence of (candidates (m, p), values (m,))
    n : int

    Returns
    -------
    candidates : ndarray of shape (k, p)
    values : ndarray of shape (k,)
    """
    candidates, values = (np.concatenate(column) for column in zip(*batches, strict=True))
    places = np.unique(np.geomspace(1, len(values), n).astype(int)) - 1
    chosen = np.argsort(-values, kind="stable")[places]
    return candidates[chosen], values[chosen]
