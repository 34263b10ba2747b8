"""Checks that the policies share."""

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["checked_bounds", "checked_times"]


def checked_bounds(bounds: object) -> tuple[float, float] | None:
    """Limits of every action as two floats, low < high, or None."""
    if bounds is None:
        return None
    try:
        low, high = (float(bound) for bound in bounds)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise ValueError(f"bounds must be None or a pair (low, high); got {bounds!r}.") from error
    if not low < high:
        raise ValueError(f"bounds must satisfy low < high; got ({low}, {high}).")
    return low, high


def checked_times(times: ArrayLike, n: int) -> None:
    """Refuse times that are not one a row."""
    if np.shape(times) != (n,):
        raise ValueError(f"times must have shape ({n},), one a row; got {np.shape(times)}.")
