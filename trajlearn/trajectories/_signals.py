"""Values of a logged signal at any time of an episode, by linear interpolation."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def interpolate(times: Floats, values: Floats, first: Ints, last: Ints, at: Floats) -> Floats:
    """Rows of a signal at times of one's own, each within rows of one episode.

    On a sample the value is that of the sample, bit for bit; before the first and after the last
    row it is held. A row of the result depends on its own stretch only.

    Parameters
    ----------
    times : ndarray of shape (N,)
        Increasing within each episode.
    values : ndarray of shape (N, k)
    first, last : ndarray of shape (m,)
        First and last row that each query may use.
    at : ndarray of shape (m,)

    Returns
    -------
    ndarray of shape (m, k)
    """
    low, high = first.copy(), last.copy()
    while (high - low > 1).any():
        middle = (low + high) // 2
        before = times[middle] <= at
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    above = np.minimum(low + 1, last)
    step = times[above] - times[low]
    weight = np.clip((at - times[low]) / np.where(step > 0, step, 1.0), 0.0, 1.0)[:, None]
    # take() copies whole rows, several times as fast as indexing with [rows]
    return values.take(low, axis=0) * (1 - weight) + values.take(above, axis=0) * weight
