"""A learner of sequences of rows with an LSTM: plain weights, to be cloned, pickled, saved."""

from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import Tags, check_random_state

from trajlearn.dynamics._recurrent import SequenceNetwork, Sequences, Stepper, train
from trajlearn.regressors._device import find_device
from trajlearn.regressors._losses import GaussianNLL, Loss, SquaredError
from trajlearn.regressors._prediction import bounded
from trajlearn.regressors._samples import standardisation
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors._training import Settings

__all__ = ["SequenceLearner"]

Floats = NDArray[np.float64]

# exponent of beta-NLL, the default of MLPEnsembleRegressor
_NLL_BETA = 0.5
# training that ends further than this from the targets, in units of their spread, has failed
_DIVERGED = 10.0
# sequences that the residual variance is computed on, evenly spaced
_REFERENCE_SEQUENCES = 512


def default_steps(n_rows: int) -> int:
    """Gradient steps that suit a number of rows: 12 n^0.55, from 60 to 2,500."""
    return int(np.clip(12 * n_rows**0.55, 60, 2500))


class SequenceLearner(RegressorMixin, BaseEstimator):
    """Regressor of rows that follow one another: what `LSTMRegressor` fits on scaled rows.

    Parameters as in `LSTMRegressor`, which has checked them. Targets are standardised inside.
    """

    def __init__(
        self,
        *,
        hidden_size: int = 64,
        n_layers: int = 1,
        probabilistic: bool = False,
        learning_rate: float = 2e-2,
        schedule: str = "one-cycle",
        batch_size: int = 8,
        max_steps: int | None = None,
        max_epochs: int | None = None,
        weight_decay: float = 0.0,
        window: int | None = None,
        device: str = "cpu",
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        self.hidden_size = hidden_size
        self.n_layers = n_layers
        self.probabilistic = probabilistic
        self.learning_rate = learning_rate
        self.schedule = schedule
        self.batch_size = batch_size
        self.max_steps = max_steps
        self.max_epochs = max_epochs
        self.weight_decay = weight_decay
        self.window = window
        self.device = device
        self.random_state = random_state
        self.verbose = verbose

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def fit(self, X: Floats, y: Floats, *, groups: NDArray[Any] | None = None) -> Self:
        """Train on rows (n, k) and targets (n,) or (n, d).

        Neighbouring rows with one label in `groups` are a sequence; without labels each row is one.
        """
        self._y_ndim = y.ndim
        y = y.reshape(len(y), -1)
        self.target_mean_, self.target_scale_ = standardisation(y, None)
        offsets = np.arange(len(y) + 1)
        if groups is not None:
            offsets = np.flatnonzero(np.concatenate([[True], groups[1:] != groups[:-1], [True]]))
        device = find_device(self.device)
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31, size=4))
        z = (y - self.target_mean_) / self.target_scale_
        data = Sequences(
            torch.tensor(X, dtype=torch.float32, device=device),
            torch.tensor(z, dtype=torch.float32, device=device),
            offsets,
        )
        n_outputs = y.shape[1] * (2 if self.probabilistic else 1)
        network = SequenceNetwork(
            X.shape[1], n_outputs, self.hidden_size, self.n_layers, seed=int(rng.integers(2**62))
        ).to(device)
        loss: Loss = SquaredError()
        if self.probabilistic:
            loss = GaussianNLL(1, y.shape[1], _NLL_BETA, data.targets)
        self.n_steps_ = self._budget(data, len(y))
        self.loss_curve_ = train(
            network,
            loss,
            data.batches(self.batch_size, self.window, rng),
            Settings(self.n_steps_, self.learning_rate, self.schedule, bool(self.verbose)),
            weight_decay=self.weight_decay,
        )
        residual = self._residual_std(network, data, rng)
        self.weights_ = network.weights()
        self.logvar_bounds_ = np.array([bound.cpu().numpy()[0, 0] for bound in loss.parameters()])
        self.residual_std_ = residual * self.target_scale_
        return self

    def _budget(self, data: Sequences, n_rows: int) -> int:
        if self.max_epochs is not None:
            return self.max_epochs * -(-len(data) // self.batch_size)
        if self.max_steps is not None:
            return self.max_steps
        return default_steps(n_rows)

    def _residual_std(
        self, network: SequenceNetwork, data: Sequences, rng: np.random.Generator
    ) -> Floats:
        """Spread of the residuals of standardised targets (d,), or an error if it is hopeless."""
        n_reference = min(len(data), _REFERENCE_SEQUENCES)
        reference = np.linspace(0, len(data) - 1, n_reference).astype(np.intp)
        total, n_rows = np.zeros(data.targets.shape[1]), 0
        with torch.inference_mode(), threads_for(0.0):
            for at in range(0, n_reference, self.batch_size):
                x, y, mask = data.padded(reference[at : at + self.batch_size], None, rng)
                squared = (network(x, mask)[:, : y.shape[1]] - y).double() ** 2
                total += squared.sum(dim=0).cpu().numpy()
                n_rows += len(y)
        std: Floats = np.sqrt(total / n_rows)
        worst = std.max()
        if not worst <= _DIVERGED:
            raise ValueError(
                f"training diverged (the residuals are {worst:.3g} times the spread of the "
                "targets): use a smaller learning_rate, or scale the inputs."
            )
        return std

    def stepper(self, n_sequences: int) -> Stepper:
        """Evaluates `n_sequences` sequences step by step, from an empty memory."""
        return Stepper(self.weights_, n_sequences, find_device(self.device))

    def moments(self, outputs: Floats) -> tuple[Floats, Floats]:
        """Mean and variance (m, d) from the outputs of a stepper."""
        n_targets = len(self.target_mean_)
        mean = outputs[:, :n_targets] * self.target_scale_ + self.target_mean_
        if not self.probabilistic:
            return mean, np.broadcast_to(self.residual_std_**2, mean.shape)
        low, high = self.logvar_bounds_.astype(np.float64)
        logvar = bounded(outputs[:, n_targets:], low, high)
        return mean, np.exp(logvar) * self.target_scale_**2

    def predict(self, X: Floats, return_std: bool = False) -> Any:
        """Mean, and standard deviation, of each row as a sequence of length one."""
        mean, variance = self.moments(self.stepper(len(X)).step(X))
        if self._y_ndim == 1:
            mean, variance = mean[:, 0], variance[:, 0]
        return (mean, np.sqrt(variance)) if return_std else mean
