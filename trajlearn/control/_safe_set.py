"""Candidates that are likely enough to keep a constraint."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Guarded", "best_to_worst", "ranked"]

Floats = NDArray[np.float64]

# more than the logarithm of any float
_BELOW = 1e3
# so that values weigh less than a difference of violations, of 1 / 50,000 or more
_TIE = 1e-5


def ranked(value: Floats, violation: Floats | None, limit: float) -> Floats:
    """Numbers in the order of values, and below them all that violate too much, least first.

    So an optimiser that begins where all violates is led to where less does, whatever the values
    are there; they decide between equal violations only.

    Parameters
    ----------
    value : ndarray of shape (m,)
    violation : ndarray of shape (m,) or None
        None leaves values as they are.
    limit : float
        Greatest violation that is none.

    Returns
    -------
    ndarray of shape (m,)
        -inf where the value is not finite.
    """
    known = np.isfinite(value)
    if violation is None:
        return np.where(known, value, -np.inf)
    # within 710 of 0, in the order of values
    order = np.sign(value) * np.log1p(np.abs(value))
    broken = -_BELOW * (1.0 + violation) + _TIE * order
    return np.where(known, np.where(violation <= limit, order, broken), -np.inf)


class Guarded:
    """Ranks of candidates for an optimiser, see `ranked`; it remembers the first of all it saw.

    Parameters
    ----------
    assess : callable
        From candidates to an `Assessment`.
    max_violation : float
    shape : tuple of int
        What a candidate is reshaped to before it is assessed.

    Attributes
    ----------
    best : ndarray of shape (d,) or None
        The candidate of the greatest value among those that keep the constraint, or, where none
        does, the one that breaks it least; None where none has a finite value.
    value : float
    violation : float or None
        Of `best`.
    """

    def __init__(
        self, assess: Callable[[Floats], Any], max_violation: float, shape: tuple[int, ...]
    ) -> None:
        self._assess = assess
        self._max_violation = max_violation
        self._shape = shape
        self._rank = -np.inf
        self.best: Floats | None = None
        self.value = -np.inf
        self.violation: float | None = None

    def __call__(self, candidates: Floats) -> Floats:
        """Ranks (m,) of flat candidates (m, d)."""
        found = self._assess(candidates.reshape(len(candidates), *self._shape))
        ranks = ranked(found.value, found.violation, self._max_violation)
        at = int(ranks.argmax())
        if ranks[at] > self._rank:
            self._rank, self.best = float(ranks[at]), candidates[at].copy()
            self.value = float(found.value[at])
            self.violation = None if found.violation is None else float(found.violation[at])
        return ranks


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
