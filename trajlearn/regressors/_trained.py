"""Training an ensemble on batches: what it sets beside the weights, and when it has failed."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.regressors._batches import Batch, ToTensors
from trajlearn.regressors._device import find_device
from trajlearn.regressors._ensemble import Ensemble
from trajlearn.regressors._fitted import FittedEnsemble
from trajlearn.regressors._samples import Rows
from trajlearn.regressors._training import Settings, Validation
from trajlearn.regressors._variance import VarianceEnsemble

__all__ = ["REFERENCE_ROWS", "TrainedEnsemble"]

Floats = NDArray[np.float64]

# rows of a stream that fix the scale of the targets and the residual variance
REFERENCE_ROWS = 16_384
# training that ends further than this from the targets, in units of their spread, has failed
_DIVERGED = 10.0
# what a fit with networks of the variance sets beside the rest
_OF_VARIANCE = {
    "variance_coefs_",
    "variance_intercepts_",
    "variance_loss_curve_",
    "_variance_moments",
}


class TrainedEnsemble(FittedEnsemble):
    """Training of `MLPEnsembleRegressor`, once its rows have become batches."""

    hidden_layer_sizes: Sequence[int]
    learning_rate: float
    n_features_in_: int
    n_members: int
    n_steps_: int
    nll_beta: float
    loss_curve_: Floats
    patience: int
    schedule: str
    validation_loss_curve_: Floats
    variance_loss_curve_: Floats
    verbose: Any
    warm_start: bool
    weight_decay: float
    _moments: list[NDArray[np.float32]]
    _variance_moments: list[NDArray[np.float32]]

    def _to_tensors(self) -> ToTensors:
        return ToTensors(self.target_mean_, self.target_scale_, find_device(self.device))

    def _train(
        self,
        batches: Iterator[Batch],
        rows: Rows,
        n_steps: int,
        rng: np.random.Generator,
        *,
        validation: Rows | None = None,
        unseen: Iterator[Batch] | None = None,
        one_pass: bool = False,
    ) -> None:
        """Train, and measure the residuals on `rows`; then the variance, where it is separate.

        `unseen` are batches of what each bootstrapped member was not trained on.
        """
        fitted = hasattr(self, "coefs_")
        go_on, moments = (one_pass or self.warm_start) and fitted, one_pass and fitted
        schedule = "constant" if one_pass else self.schedule
        settings = Settings(n_steps, self.learning_rate, schedule, verbose=bool(self.verbose))
        held = None
        if validation is not None:
            tensors = self._to_tensors()(validation.X, validation.y, validation.weight)
            held = Validation(*tensors, self.patience)
        joint = self.probabilistic and not self._separate()
        ensemble = Ensemble(
            self.n_features_in_,
            len(self.target_mean_),
            self.hidden_layer_sizes,
            self.n_members,
            self.activation,
            nll_beta=self.nll_beta if joint else None,
            weight_decay=self.weight_decay,
            device=find_device(self.device),
            seed=int(rng.integers(2**62)),
        )
        if go_on:
            bounds = self.logvar_bounds_ if joint else ensemble.bounds()
            ensemble.resume(
                self.coefs_, self.intercepts_, bounds, self._moments if moments else None
            )
        curves = ensemble.train(batches, settings, held)
        self.n_steps_, self.loss_curve_, self.validation_loss_curve_ = curves
        self.coefs_, self.intercepts_ = ensemble.weights(), ensemble.biases()
        self._moments = ensemble.optimizer.moments()
        peak = self._set_residuals(rows, limit=np.inf if one_pass else _DIVERGED)
        if self._separate():
            variance = VarianceEnsemble(
                ensemble.network,
                self.activation,
                residual_std=self.residual_std_ / self.target_scale_,
                residual_peak=peak,
                weight_decay=self.weight_decay,
                seed=int(rng.integers(2**62)),
            )
            self._train_variance(variance, unseen or batches, settings, held, go_on, moments)
            return
        self.logvar_bounds_ = ensemble.bounds()
        for name in _OF_VARIANCE & vars(self).keys():
            delattr(self, name)

    def _train_variance(
        self,
        variance: VarianceEnsemble,
        batches: Iterator[Batch],
        settings: Settings,
        held_out: Validation | None,
        go_on: bool,
        moments: bool,
    ) -> None:
        """Train the networks of the variance; a mean may go on where they are new."""
        if go_on and hasattr(self, "variance_coefs_"):
            variance.resume(
                self.variance_coefs_,
                self.variance_intercepts_,
                self.logvar_bounds_,
                self._variance_moments if moments else None,
            )
        _, self.variance_loss_curve_, _ = variance.train(batches, settings, held_out)
        self.variance_coefs_, self.variance_intercepts_ = variance.weights(), variance.biases()
        self.logvar_bounds_ = variance.bounds()
        self._variance_moments = variance.optimizer.moments()

    def _separate(self) -> bool:
        return self.probabilistic == "separate"

    def _set_residuals(self, rows: Rows, *, limit: float) -> Floats:
        """Spread of the residuals on (at most some thousand of) the training rows.

        Returns the greatest (E, n_targets), of standardised targets. Raises, and leaves the
        estimator unfitted, if the spread exceeds `limit` times the targets' own.
        """
        rows = rows.thinned(REFERENCE_ROWS)
        residuals = self.predictor(means_only=True)(rows.X)[..., : rows.y.shape[1]] - rows.y
        self.residual_std_ = np.sqrt(np.average(residuals**2, axis=1, weights=rows.weight))
        worst = float((self.residual_std_ / self.target_scale_).max())
        if not (worst < limit and np.isfinite(self.loss_curve_).all()):
            del self.coefs_
            raise ValueError(
                f"training diverged (the residuals are {worst:.3g} times the spread of the "
                f"targets): scale the inputs, or lower learning_rate (now {self.learning_rate:g})."
            )
        greatest: Floats = np.abs(residuals).max(axis=1) / self.target_scale_
        return greatest
