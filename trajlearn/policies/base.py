"""What a policy is."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Policy"]


class Policy(Protocol):
    """What is called a policy: a vectorised function ``(states, params, times) -> actions``.

    ``states`` is (n, d_s), ``params`` (n, p), ``times`` (n,) in the unit of the episodes'
    times, and the answer (n, d_a). Row i may depend on row i of the arguments only. A class
    need not inherit from this one; a plain function will do.
    """

    def __call__(
        self,
        states: NDArray[np.float64],
        params: NDArray[np.float64],
        times: NDArray[np.float64],
        /,
    ) -> NDArray[np.float64]:
        """Return the actions, shape (n, d_a)."""
        ...
