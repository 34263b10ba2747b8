"""Training an ensemble on batches: what it sets beside the weights, and when it has failed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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

__all__ = ["REFERENCE_ROWS", "Curves", "TrainedEnsemble", "Training"]

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


# steps taken, losses and held-out losses, as `Ensemble.train` gives them
Curves = tuple[int, Floats, Floats]


@dataclass(frozen=True, eq=False)
class Training:
    """What a fit trains on, and for how long.

    Attributes
    ----------
    batches : iterator of Batch
    rows : Rows
        On which the residuals are measured.
    n_steps : int
    rng : Generator
    validation : Rows or None
        Held out.
    unseen : iterator of Batch or None
        Of what each bootstrapped member is not trained on.
    goes_on : bool
        From the weights of the last fit.
    one_pass : bool
        At the constant rate and with the moments of the last fit, and never a failure.
    """

    batches: Iterator[Batch]
    rows: Rows
    n_steps: int
    rng: np.random.Generator
    validation: Rows | None = None
    unseen: Iterator[Batch] | None = None
    goes_on: bool = False
    one_pass: bool = False


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
    weight_decay: float
    _moments: list[NDArray[np.float32]]
    _variance_moments: list[NDArray[np.float32]]

    def _to_tensors(self) -> ToTensors:
        return ToTensors(self.target_mean_, self.target_scale_, find_device(self.device))

    def _train(self, training: Training) -> None:
        """Train; then the variance, where it is separate."""
        ensemble = self._begun(training)
        settings, held = self._settings(training), self._held_out(training)
        self._finish(ensemble, ensemble.train(training.batches, settings, held), training)

    def _finish(self, ensemble: Ensemble, curves: Curves, training: Training) -> None:
        """Keep trained networks; train the variance, where it is separate."""
        settings, held = self._settings(training), self._held_out(training)
        peak = self._take(ensemble, curves, training)
        if self._separate():
            variance = self._begun_variance(training, ensemble, peak)
            curves = variance.train(training.unseen or training.batches, settings, held)
            self._take_variance(variance, curves)

    def _begun(self, training: Training) -> Ensemble:
        """Networks that training starts from: new ones, or those of the last fit."""
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
            seed=int(training.rng.integers(2**62)),
        )
        if training.goes_on:
            bounds = self.logvar_bounds_ if joint else ensemble.bounds()
            moments = self._moments if training.one_pass else None
            ensemble.resume(self.coefs_, self.intercepts_, bounds, moments)
        return ensemble

    def _settings(self, training: Training) -> Settings:
        schedule = "constant" if training.one_pass else self.schedule
        return Settings(training.n_steps, self.learning_rate, schedule, verbose=bool(self.verbose))

    def _held_out(self, training: Training) -> Validation | None:
        rows = training.validation
        if rows is None:
            return None
        return Validation(*self._to_tensors()(rows.X, rows.y, rows.weight), self.patience)

    def _take(self, ensemble: Ensemble, curves: Curves, training: Training) -> Floats:
        """Keep trained networks; greatest residuals (E, n_targets), of standardised targets."""
        self.n_steps_, self.loss_curve_, self.validation_loss_curve_ = curves
        self.coefs_, self.intercepts_ = ensemble.weights(), ensemble.biases()
        self._moments = ensemble.optimizer.moments()
        limit = np.inf if training.one_pass else _DIVERGED
        peak = self._set_residuals(training.rows, limit=limit)
        if not self._separate():
            self.logvar_bounds_ = ensemble.bounds()
            for name in _OF_VARIANCE & vars(self).keys():
                delattr(self, name)
        return peak

    def _begun_variance(
        self, training: Training, ensemble: Ensemble, peak: Floats
    ) -> VarianceEnsemble:
        """Networks of the variance; a mean may go on where they are new."""
        variance = VarianceEnsemble(
            ensemble.network,
            self.activation,
            residual_std=self.residual_std_ / self.target_scale_,
            residual_peak=peak,
            weight_decay=self.weight_decay,
            seed=int(training.rng.integers(2**62)),
        )
        if training.goes_on and hasattr(self, "variance_coefs_"):
            moments = self._variance_moments if training.one_pass else None
            variance.resume(
                self.variance_coefs_, self.variance_intercepts_, self.logvar_bounds_, moments
            )
        return variance

    def _take_variance(self, variance: VarianceEnsemble, curves: Curves) -> None:
        self.variance_loss_curve_ = curves[1]
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
