"""Features of the phase: where in a motion a time is."""

from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from trajlearn._sklearn import Interval

__all__ = ["PhaseFeatures"]

Floats = NDArray[np.float64]


class PhaseFeatures(TransformerMixin, BaseEstimator):
    r"""Fourier features of a phase, and the phase itself scaled to [-1, 1].

    With the range [a, b] of the training phases and P = 1.25 (b - a), longer than the motion so
    that its end does not look like its beginning: :math:`\sin` and :math:`\cos` of
    :math:`2 \pi k (x - a) / P` for k = 1, ..., `n_harmonics`. A network that sees the phase alone
    cannot resolve where in the motion it is.

    Parameters
    ----------
    n_harmonics : int, default=8

    Attributes
    ----------
    low_, period_ : ndarray of shape (n_columns,)

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import PhaseFeatures
    >>> PhaseFeatures(n_harmonics=1).fit_transform(np.array([[0.0], [1.0], [2.0]])).round(2)
    array([[-1.  ,  0.  ,  1.  ],
           [ 0.  ,  0.59, -0.81],
           [ 1.  , -0.95,  0.31]])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_harmonics": [Interval(Integral, 0, None, closed="left")]
    }

    def __init__(self, *, n_harmonics: int = 8) -> None:
        self.n_harmonics = n_harmonics

    def fit(self, X: ArrayLike, y: None = None) -> Self:
        """Learn the range of each column.

        Parameters
        ----------
        X : array-like of shape (n, n_columns)
        y : None

        Returns
        -------
        self
        """
        self._validate_params()
        phase = validate_data(self, X, dtype=np.float64)
        self.low_ = phase.min(axis=0)
        width = phase.max(axis=0) - self.low_
        self.period_ = 1.25 * np.where(width > 0, width, 1.0)
        return self

    def transform(self, X: ArrayLike) -> Floats:
        """Features of phases.

        Parameters
        ----------
        X : array-like of shape (n, n_columns)

        Returns
        -------
        ndarray of shape (n, (1 + 2 * n_harmonics) * n_columns)
        """
        check_is_fitted(self)
        return self.features(validate_data(self, X, dtype=np.float64, reset=False))

    def features(self, phase: Floats) -> Floats:
        """`transform` without validation, for hot loops."""
        share = (phase - self.low_) / self.period_
        angles = [2 * np.pi * k * share for k in range(1, self.n_harmonics + 1)]
        waves = [wave(angle) for angle in angles for wave in (np.sin, np.cos)]
        return np.concatenate([2.5 * share - 1, *waves], axis=1)
