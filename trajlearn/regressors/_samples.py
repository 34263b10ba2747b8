"""Preparing rows: sample weights that equal repeated rows, bootstrap, held-out rows."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupShuffleSplit, ShuffleSplit
from sklearn.utils.validation import column_or_1d

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Rows:
    """Inputs (n, d), targets (n, k), weights (n,) or None, group labels (n,) or None."""

    X: Floats
    y: Floats
    weight: Floats | None = None
    groups: NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.X)

    def take(self, index: NDArray[Any]) -> Self:
        """Rows of an index or mask."""
        weight = None if self.weight is None else self.weight[index]
        groups = None if self.groups is None else self.groups[index]
        return type(self)(self.X[index], self.y[index], weight, groups)

    def thinned(self, limit: int) -> Self:
        """At most `limit` rows, evenly spaced."""
        if len(self) <= limit:
            return self
        return self.take(np.linspace(0, len(self) - 1, limit).astype(np.intp))

    def without_weightless(self) -> Self:
        """Leave out rows of weight zero: they must not even move a random draw.

        Raises
        ------
        ValueError
            If a weight is negative.
        """
        if self.weight is None:
            return self
        if (self.weight < 0).any():
            raise ValueError(
                "sample_weight has negative values; weights count how often a row is seen."
            )
        return self.take(self.weight > 0)

    def merged(self, limit: int) -> Self:
        """Different rows in sorted order with summed weights, so that weights equal repeats.

        Rows of different groups differ. Unchanged if there are more than `limit`.
        """
        blocks: list[NDArray[Any]] = [self.X, self.y]
        if self.groups is not None:
            labels, code = np.unique(self.groups, return_inverse=True)
            blocks.append(code.reshape(-1, 1))
        joined = np.concatenate(blocks, axis=1)
        # nearly always the first column tells, and sorting whole rows is saved
        if len(joined) > limit and any(len(np.unique(column)) > limit for column in joined.T):
            return self
        rows, inverse = np.unique(joined, axis=0, return_inverse=True)
        if len(rows) > limit:
            return self
        weight = np.bincount(inverse.ravel(), weights=self.weight, minlength=len(rows))
        X, y, code = np.split(rows, np.cumsum([self.X.shape[1], self.y.shape[1]]), axis=1)
        groups = None if self.groups is None else labels[code[:, 0].astype(np.intp)]
        return type(self)(X, y, weight.astype(np.float64), groups)


def check_groups(groups: Any, n_rows: int) -> NDArray[Any]:
    """Group labels as an array (n,).

    Raises
    ------
    ValueError
        If there is not one label a row.
    """
    groups = column_or_1d(groups)
    if len(groups) != n_rows:
        raise ValueError(f"groups has {len(groups)} labels for {n_rows} rows; give one a row.")
    return groups


def standardisation(y: Floats, weight: Floats | None) -> tuple[Floats, Floats]:
    """Weighted mean and standard deviation of the targets; the scale of a constant is 1."""
    mean = np.average(y, axis=0, weights=weight)
    scale = np.sqrt(np.average((y - mean) ** 2, axis=0, weights=weight))
    return mean, np.where(scale > 1e-12 * np.maximum(np.abs(mean), 1e-300), scale, 1.0)


def bootstrap_counts(
    n_rows: int, groups: NDArray[Any] | None, n_members: int, rng: np.random.Generator
) -> Floats:
    """How often each member sees each row (E, n): rows, or whole groups, drawn with replacement."""
    units = np.arange(n_rows) if groups is None else np.unique(groups, return_inverse=True)[1]
    n_units = int(units.max()) + 1
    drawn = rng.integers(n_units, size=(n_members, n_units))
    counts = np.stack([np.bincount(d, minlength=n_units) for d in drawn])
    return counts[:, units.ravel()].astype(np.float64)


def held_out(rows: Rows, fraction: float, rng: np.random.Generator) -> tuple[Rows, Rows]:
    """Rows for training and for validation; whole groups stay together.

    Raises
    ------
    ValueError
        If there is only one row or group.
    """
    units = len(rows) if rows.groups is None else len(np.unique(rows.groups))
    if units < 2:
        what = "row" if rows.groups is None else "group"
        raise ValueError(f"early_stopping needs at least two {what}s to hold one out; there is 1.")
    split = ShuffleSplit if rows.groups is None else GroupShuffleSplit
    splitter = split(n_splits=1, test_size=fraction, random_state=int(rng.integers(2**31)))
    train, validation = next(splitter.split(rows.X, groups=rows.groups))
    return rows.take(train), rows.take(validation)
