"""Least squares on monomials of the inputs, chosen one by one, through a saturating output.

A controller is mostly a short formula, clipped: gains times errors. Where its output is clipped
only a bound is known of what it would have been, and least squares on the clipped values fits
neither the slope nor the corner. Here such a row counts only while the formula is inside the
limits there; the sum of squares stays convex, and Newton's method, which refits on the rows that
count until they are the same, finds its minimum in a few rounds.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Normal",
    "forward_errors",
    "forward_order",
    "held_out_error",
    "monomials",
    "saturated_fit",
    "sum_of",
    "terms_of",
]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Term = tuple[int, ...]

_ROUNDS = 50
# share of a column's square that must be new for it to enter
_NEW = 1e-10


def terms_of(columns: list[int], degree: int) -> list[Term]:
    """Monomials of some columns up to a degree, the constant first."""
    return [
        term
        for power in range(degree + 1)
        for term in combinations_with_replacement(columns, power)
    ]


def monomials(X: Floats, terms: list[Term]) -> Floats:
    """Values of monomials (n, n_terms)."""
    values = np.ones((len(X), len(terms)))
    for place, term in enumerate(terms):
        for column in term:
            values[:, place] *= X[:, column]
    return values


@dataclass(frozen=True, eq=False)
class Normal:
    """Sums that least squares needs: Z'Z, Z'y, y'y and the total weight of the rows."""

    gram: Floats
    moment: Floats
    square: float
    weight: float

    @classmethod
    def of(cls, Z: Floats, y: Floats, weight: Floats) -> "Normal":
        """Those of rows."""
        weighted = Z * weight[:, None]
        return cls(Z.T @ weighted, weighted.T @ y, float(weight @ y**2), float(weight.sum()))

    def __add__(self, other: "Normal") -> "Normal":
        return Normal(
            self.gram + other.gram,
            self.moment + other.moment,
            self.square + other.square,
            self.weight + other.weight,
        )

    def __sub__(self, other: "Normal") -> "Normal":
        return Normal(
            self.gram - other.gram,
            self.moment - other.moment,
            self.square - other.square,
            self.weight - other.weight,
        )

    def solved(self, chosen: list[int], ridge: float) -> Floats:
        """Coefficients of some columns; `ridge` is a share of the mean square of a column."""
        gram = self.gram[np.ix_(chosen, chosen)]
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        system = gram / np.outer(scale, scale) + ridge * np.eye(len(gram))
        return np.linalg.lstsq(system, self.moment[chosen] / scale, rcond=1e-14)[0] / scale

    def error(self, chosen: list[int], coefficients: Floats) -> float:
        """Sum of squared residuals."""
        fitted = self.gram[np.ix_(chosen, chosen)] @ coefficients
        own = self.square - 2 * coefficients @ self.moment[chosen] + coefficients @ fitted
        return max(float(own), 0.0)


def forward_order(sums: Normal, most: int) -> list[int]:
    """Columns in the order in which each lowers the sum of squares most (orthogonal matching)."""
    own = np.diag(sums.gram)
    left, moment = own.copy(), sums.moment.copy()
    basis = np.zeros((len(own), most))
    order: list[int] = []
    for k in range(most):
        # what a column has on top of those chosen
        new = left > _NEW * np.maximum(own, 1e-300)
        gain = np.where(new, moment**2 / np.maximum(left, 1e-300), -1.0)
        gain[order] = -1.0
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        root = np.sqrt(left[best])
        direction = (sums.gram[:, best] - basis[:, :k] @ basis[best, :k]) / root
        basis[:, k] = direction
        moment = moment - direction * (moment[best] / root)
        left = left - direction**2
        order.append(best)
    return order


def forward_errors(folds: list[Normal], most: int, ridge: float) -> Floats:
    """Held-out sum of squares after 0, 1, ... `most` columns, each fold left out once."""
    total = sum_of(folds)
    errors = np.zeros(most + 1)
    for fold in folds:
        rest = total - fold
        order = forward_order(rest, most)
        errors[0] += fold.square
        reached = fold.square
        for k in range(1, most + 1):
            if k <= len(order):
                reached = fold.error(order[:k], rest.solved(order[:k], ridge))
            errors[k] += reached
    return errors


def held_out_error(folds: list[Normal], ridge: float) -> float:
    """Held-out sum of squares of all columns, each fold left out once."""
    total, every = sum_of(folds), list(range(len(folds[0].moment)))
    if len(folds) == 1:
        return total.square
    return sum(fold.error(every, (total - fold).solved(every, ridge)) for fold in folds)


def sum_of(folds: list[Normal]) -> Normal:
    """Sums of all folds."""
    total = folds[0]
    for fold in folds[1:]:
        total = total + fold
    return total


def saturated_fit(
    Z: Floats, y: Floats, weight: Floats, limits: tuple[float, float], ridge: float
) -> Floats:
    """Coefficients w that minimise the squares of clip(Z w, limits) - y, as far as that is convex.

    Parameters
    ----------
    Z : ndarray of shape (n, k)
    y, weight : ndarray of shape (n,)
        Targets within the limits; weights of the rows.
    limits : (low, high)
    ridge : float

    Returns
    -------
    ndarray of shape (k,)
    """
    low, high = limits
    near = 1e-9 * (high - low)
    at_low, at_high = y <= low + near, y >= high - near
    counts = np.ones(len(y), dtype=bool)
    sums, every = Normal.of(Z, y, weight), list(range(Z.shape[1]))
    coefficients = sums.solved(every, ridge)
    for _ in range(_ROUNDS):
        fitted = Z @ coefficients
        now = ~((at_low & (fitted <= low)) | (at_high & (fitted >= high)))
        changed = np.flatnonzero(now != counts)
        if not len(changed):
            break
        sign = np.where(now[changed], 1.0, -1.0) * weight[changed]
        sums, counts = sums + Normal.of(Z[changed], y[changed], sign), now
        coefficients = sums.solved(every, ridge)
    return coefficients
