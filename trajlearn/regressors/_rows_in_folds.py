"""Rows, targets and weights of a learner that judges its candidates by held-out groups."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.regressors._saturated import Floats, Normal, Term, monomials

__all__ = ["RowsInFolds", "dealt", "spread_of"]

Ints = NDArray[np.intp]

# with fewer groups than that each is left out once, with more they are dealt to four folds
_FEW_GROUPS, _FOLDS = 10, 4
# rows and inputs with which it costs little to choose for each fold again
_FEW_ROWS, _FEW_INPUTS = 2500, 20


@dataclass(frozen=True, eq=False)
class RowsInFolds:
    """Rows, targets (n, d), weights and folds."""

    X: Floats
    y: Floats
    weight: Floats
    fold: Ints

    def at(self, rows: NDArray[Any]) -> "RowsInFolds":
        return RowsInFolds(self.X[rows], self.y[rows], self.weight[rows], self.fold[rows])

    def sums(self, terms: list[Term], j: int) -> list[Normal]:
        """What least squares of a target needs of each fold."""
        Z, y, weight = monomials(self.X, terms), self.y[:, j], self.weight
        masks = (self.fold == k for k in np.unique(self.fold))
        return [Normal.of(Z[own], y[own], weight[own]) for own in masks]

    @property
    def is_small(self) -> bool:
        """Whether it costs little to choose terms again and again."""
        return len(self.X) <= _FEW_ROWS and self.X.shape[1] <= _FEW_INPUTS

    def splits(self) -> list[tuple["RowsInFolds", "RowsInFolds"]]:
        """Rows to fit on, and rows to judge by: every fold once, or the last where they are many.

        All rows twice where there is one fold.
        """
        folds = np.unique(self.fold)
        if len(folds) == 1:
            return [(self, self)]
        judged = folds if self.is_small else folds[-1:]
        return [(self.at(self.fold != k), self.at(self.fold == k)) for k in judged]


def spread_of(y: Floats, weight: Floats) -> Any:
    """Standard deviation of targets (n, ...)."""
    mean = np.average(y, axis=0, weights=weight)
    return np.sqrt(np.average((y - mean) ** 2, axis=0, weights=weight))


def dealt(rows: Floats, groups: NDArray[Any] | None) -> Ints:
    """Fold of each row: whole groups, dealt in turn; equal rows are one where there is one group.

    A row of weight k is then in one fold, as k equal rows are.
    """
    of_row = np.zeros(len(rows), dtype=np.intp)
    if groups is not None:
        of_row = np.unique(groups, return_inverse=True)[1]
    if not of_row.any():
        of_row = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    n_labels = of_row.max() + 1
    return of_row % (n_labels if n_labels < _FEW_GROUPS else _FOLDS)
