"""Features of the horizon."""

from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from trajlearn._sklearn import Interval

__all__ = ["HorizonFeatures"]

Floats = NDArray[np.float64]


class HorizonFeatures(TransformerMixin, BaseEstimator):
    r"""Features of a horizon h on all time scales of the data.

    With L the longest horizon and d the shortest: :math:`2h/L - 1`,
    :math:`2\,\mathrm{arsinh}(h/d)/\mathrm{arsinh}(L/d) - 1` (a logarithm that is defined for all h)
    and :math:`1 - 2\exp(-|h|/\tau)` for `n_scales` decay times :math:`\tau` in geometric steps
    from 2 d to L. A network that sees h alone cannot resolve its first steps.

    Parameters
    ----------
    n_scales : int, default=6
        Number of decay times.

    Attributes
    ----------
    longest_, shortest_ : ndarray of shape (n_columns,)
    scales_ : ndarray of shape (n_scales, n_columns)
        Decay times in the unit of h.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import HorizonFeatures
    >>> HorizonFeatures(n_scales=2).fit(np.arange(1.0, 101.0)[:, None]).scales_[:, 0]
    array([  2., 100.])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_scales": [Interval(Integral, 0, None, closed="left")]
    }

    def __init__(self, *, n_scales: int = 6) -> None:
        self.n_scales = n_scales

    def fit(self, X: ArrayLike, y: None = None) -> Self:
        """Learn L, d and the decay times of each column.

        Parameters
        ----------
        X : array-like of shape (n, n_columns)
            Horizons.
        y : None

        Returns
        -------
        self
        """
        self._validate_params()
        h = np.abs(validate_data(self, X, dtype=np.float64))
        longest = h.max(axis=0)
        self.longest_ = np.where(longest > 0, longest, 1.0)
        shortest = np.where(h > 0, h, np.inf).min(axis=0)
        self.shortest_ = np.clip(shortest, self.longest_ / 1000, self.longest_)
        first = np.minimum(2 * self.shortest_, self.longest_)
        self.scales_ = np.geomspace(first, self.longest_, self.n_scales)
        return self

    def transform(self, X: ArrayLike) -> Floats:
        """Features of horizons.

        Parameters
        ----------
        X : array-like of shape (n, n_columns)

        Returns
        -------
        ndarray of shape (n, (2 + n_scales) * n_columns)
        """
        check_is_fitted(self)
        return self.features(validate_data(self, X, dtype=np.float64, reset=False))

    def features(self, h: Floats) -> Floats:
        """`transform` without validation, for hot loops."""
        linear = 2 * h / self.longest_ - 1
        full = np.arcsinh(self.longest_ / self.shortest_)
        logarithmic = 2 * np.arcsinh(h / self.shortest_) / full - 1
        decays = [1 - 2 * np.exp(-np.abs(h) / scale) for scale in self.scales_]
        return np.concatenate([linear, logarithmic, *decays], axis=1)
