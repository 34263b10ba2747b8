"""Spectral projected gradients in the unit cube, many points at once."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Climb"]

Floats = NDArray[np.float64]

# in a cube of side 1: the first move, the longest, and one that is none any more
_FIRST_MOVE, _LONGEST_MOVE, _NO_MOVE = 0.1, 0.3, 1e-5


class Climb:
    """Points on their way up in the unit cube, each on its own.

    A point moves along its slope by a step that is the inverse of the curvature it has just met
    (Barzilai and Borwein); a move that does not lead up is taken back and tried shorter.

    Parameters
    ----------
    points : ndarray of shape (m, p)
        Where to begin.

    Attributes
    ----------
    next : ndarray of shape (m, p)
        Points to evaluate.
    values : ndarray of shape (m,)
        Of the best point so far, of each.
    """

    def __init__(self, points: Floats) -> None:
        self.next = points
        self.values = np.full(len(points), -np.inf)
        self._at, self._slopes = points, np.zeros_like(points)
        self._step = np.zeros(len(points))

    def moving(self) -> NDArray[np.bool_]:
        """Which have not come to rest (m,)."""
        moves = np.abs(self.next - self._at).max(axis=1)
        return np.asarray(moves > _NO_MOVE)

    def keep(self, rows: NDArray[np.intp]) -> None:
        """Give up all points but some."""
        self.next, self.values, self._step = self.next[rows], self.values[rows], self._step[rows]
        self._at, self._slopes = self._at[rows], self._slopes[rows]

    def tell(self, values: Floats, slopes: Floats) -> None:
        """Values (m,) and slopes (m, p) of the points to evaluate, and on from there."""
        first, up = np.isneginf(self.values), values > self.values
        moved, change = self.next - self._at, self._slopes - slopes
        bend = (moved * change).sum(axis=1)
        curved = bend > 0
        spectral = np.divide((moved**2).sum(axis=1), bend, out=4 * self._step, where=curved)
        back = np.where(curved, np.minimum(spectral, self._step / 2), self._step / 4)
        self._at = np.where(up[:, None], self.next, self._at)
        self._slopes = np.where(up[:, None], slopes, self._slopes)
        self.values = np.maximum(self.values, values)
        steepest = np.abs(self._slopes).max(axis=1)
        steepest = np.where(steepest > 0, steepest, 1.0)
        step = np.where(first, _FIRST_MOVE / steepest, np.where(up, spectral, back))
        self._step = np.minimum(step, _LONGEST_MOVE / steepest)
        self.next = np.clip(self._at + self._step[:, None] * self._slopes, 0.0, 1.0)
