"""What a fitted ensemble predicts: members, their mixture, and a fast predictor."""

from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted, validate_data

from trajlearn.regressors._device import find_device
from trajlearn.regressors._prediction import Predictor, bounded, mean_of_members, mixture
from trajlearn.regressors._variance import MeanAndVariance

Floats = NDArray[np.float64]


class FittedEnsemble(BaseEstimator):
    """Predictions of `MLPEnsembleRegressor`, from the attributes that its fit sets."""

    activation: str
    coefs_: list[NDArray[np.float32]]
    device: str
    intercepts_: list[NDArray[np.float32]]
    logvar_bounds_: NDArray[np.float32]
    probabilistic: bool | Literal["separate"]
    residual_std_: Floats
    target_mean_: Floats
    target_scale_: Floats
    variance_coefs_: list[NDArray[np.float32]]
    variance_intercepts_: list[NDArray[np.float32]]
    _y_ndim: int

    def predictor(self, *, means_only: bool = False) -> Predictor | MeanAndVariance:
        """Fast evaluation without validation, for roll-outs and planning.

        Parameters
        ----------
        means_only : bool, default=False
            Leave out the log variances where they come from networks of their own.

        Returns
        -------
        Predictor
            ``predictor(X)`` gives means (E, n, n_targets), followed on the last axis by raw log
            variances if `probabilistic`; see `moments`.
        """
        scale, shift = self.target_scale_, self.target_mean_
        log_scale, log_shift = np.ones_like(scale), np.zeros_like(shift)
        if self.probabilistic != "separate":
            if self.probabilistic:
                scale = np.concatenate([scale, log_scale])
                shift = np.concatenate([shift, log_shift])
            return self._predictor(self.coefs_, self.intercepts_, scale, shift)
        means = self._predictor(self.coefs_, self.intercepts_, scale, shift)
        if means_only:
            return means
        check_is_fitted(self, "variance_coefs_")
        variance = self.variance_coefs_, self.variance_intercepts_
        return MeanAndVariance(means, self._predictor(*variance, log_scale, log_shift))

    def _predictor(
        self,
        weights: list[NDArray[np.float32]],
        biases: list[NDArray[np.float32]],
        scale: Floats,
        shift: Floats,
    ) -> Predictor:
        return Predictor(
            weights,
            biases,
            self.activation,
            device=find_device(self.device),
            output_scale=scale,
            output_shift=shift,
        )

    def moments(self, outputs: Floats) -> tuple[Floats, Floats]:
        """Mean and variance of each member (E, n, n_targets) from a predictor's outputs."""
        n_targets = len(self.target_mean_)
        mean = outputs[..., :n_targets]
        if not self.probabilistic:
            variance = np.broadcast_to(self.residual_std_[:, None, :] ** 2, mean.shape)
            return mean, variance
        low, high = self.logvar_bounds_.astype(np.float64)
        return mean, np.exp(bounded(outputs[..., n_targets:], low, high)) * self.target_scale_**2

    def predict_members(self, X: ArrayLike) -> Floats:
        """Mean of each member (E, n, n_targets).

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        """
        rows = self._checked_rows(X)
        return self.predictor(means_only=True)(rows)[..., : len(self.target_mean_)]

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Floats: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Floats, Floats]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Floats | tuple[Floats, Floats]:
        """Mean of the members.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        return_std : bool, default=False
            Also return the standard deviation of the mixture of all members, in target units:
            the mean of their variances plus the variance of their means.

        Returns
        -------
        mean : ndarray of shape (n,) or (n, n_targets)
        std : ndarray of the same shape, if asked for
        """
        rows = self._checked_rows(X)
        column: Any = (slice(None), 0) if self._y_ndim == 1 else slice(None)
        if not return_std:
            outputs = self.predictor(means_only=True)(rows)
            mean: Floats = mean_of_members(outputs[..., : len(self.target_mean_)])[column]
            return mean
        mean, variance = mixture(*self.moments(self.predictor()(rows)))
        return mean[column], np.sqrt(variance[column])

    def _checked_rows(self, X: ArrayLike) -> Floats:
        check_is_fitted(self, "coefs_")
        rows: Floats = validate_data(self, X, reset=False, dtype=np.float64)
        return rows
