"""The best candidate that is likely enough to keep the constraint."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Guarded"]

Floats = NDArray[np.float64]


class Guarded:
    """Value of candidates for an optimiser, -inf where the constraint is broken too often.

    It remembers the best candidate that it saw: the one of the greatest value among those that
    keep the constraint, or, where none does, the one that breaks it least.

    Parameters
    ----------
    assess : callable
        From candidates to an `Assessment`.
    max_violation : float
    shape : tuple of int
        What a candidate is reshaped to before it is assessed.
    """

    def __init__(
        self, assess: Callable[[Floats], Any], max_violation: float, shape: tuple[int, ...]
    ) -> None:
        self._assess = assess
        self._max_violation = max_violation
        self._shape = shape
        # minus what the violation is too much, then the value
        self._rank = (-np.inf, -np.inf)
        self.best: Floats | None = None
        self.violation: float | None = None

    @property
    def value(self) -> float:
        """Value of the best candidate, -inf where none has a finite one."""
        return self._rank[1]

    def __call__(self, candidates: Floats) -> Floats:
        """Values (m,) of flat candidates (m, d)."""
        found = self._assess(candidates.reshape(len(candidates), *self._shape))
        value = np.where(np.isnan(found.value), -np.inf, found.value)
        share = np.zeros(len(value)) if found.violation is None else found.violation
        excess = np.where(share <= self._max_violation, 0.0, share)
        at = int(np.lexsort((value, -excess))[-1])
        rank = (-float(excess[at]), float(value[at]))
        if self.best is None or rank > self._rank:
            self._rank, self.best = rank, candidates[at].copy()
            self.violation = None if found.violation is None else float(share[at])
        return np.where(excess > 0, -np.inf, value)
