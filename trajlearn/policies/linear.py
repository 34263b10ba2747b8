"""Linear state feedback."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.policies._checks import checked_bounds, checked_times

__all__ = ["LinearFeedback"]


@dataclass(frozen=True)
class LinearFeedback:
    r"""State feedback ``a = clip(-K s, low, high)`` with the gain K as control parameters.

    Parameters
    ----------
    bounds : (low, high) or None, default=(-1.0, 1.0)
        Limits of every action; None leaves the actions unclipped.

    Raises
    ------
    ValueError
        If ``bounds`` is neither None nor two numbers with low < high.

    Notes
    -----
    A linear quadratic regulator has this form; its gain is the one that minimises
    :math:`\int_0^\infty s^T Q s + a^T R a\,dt`. A row gets the same bits alone as in a batch.

    Examples
    --------
    >>> import numpy as np
    >>> policy = LinearFeedback()
    >>> states = np.array([[0.2, 0.1], [3.0, 0.0]])
    >>> gains = np.array([[1.0, 2.0], [1.0, 2.0]])
    >>> policy(states, gains, np.zeros(2))
    array([[-0.4],
           [-1. ]])
    """

    bounds: tuple[float, float] | None = (-1.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", checked_bounds(self.bounds))

    def __call__(
        self, states: ArrayLike, params: ArrayLike, times: ArrayLike
    ) -> NDArray[np.float64]:
        """Evaluate the feedback law.

        Parameters
        ----------
        states : array-like of shape (n, d_s)
            The states to act on.
        params : array-like of shape (n, d_a * d_s)
            The gain of every row, K of shape (d_a, d_s) flattened row by row.
        times : array-like of shape (n,)
            The times of the rows; the law does not depend on them.

        Returns
        -------
        ndarray of shape (n, d_a)
            The actions, within ``bounds``.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] == 0:
            raise ValueError(f"states must have shape (n, d_s) with d_s >= 1; got {s.shape}.")
        n, d_s = s.shape
        gains = np.asarray(params, dtype=np.float64)
        if gains.ndim != 2 or len(gains) != n or gains.shape[1] == 0 or gains.shape[1] % d_s:
            raise ValueError(
                f"params must have shape (n, d_a * d_s), one flattened gain for each of the {n} "
                f"rows of states with d_s = {d_s}; got {gains.shape}."
            )
        checked_times(times, n)
        gains = gains.reshape(n, gains.shape[1] // d_s, d_s)
        # Column by column: a matrix product or a pairwise sum may round differently with n.
        actions = -gains[:, :, 0] * s[:, :1]
        for j in range(1, d_s):
            actions -= gains[:, :, j] * s[:, j : j + 1]
        return actions if self.bounds is None else np.clip(actions, *self.bounds)
