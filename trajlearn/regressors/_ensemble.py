"""A network, its loss and its optimiser: what one training run works on."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from trajlearn.regressors._batches import Batch
from trajlearn.regressors._losses import GaussianNLL, Loss, SquaredError
from trajlearn.regressors._network import BatchedMLP
from trajlearn.regressors._training import Adam, Settings, Validation, train

Singles = NDArray[np.float32]


class Ensemble:
    """E networks in training.

    Parameters
    ----------
    n_features, n_targets : int
    hidden : sequence of int
        Widths of the hidden layers.
    n_members : int
    activation : str
    nll_beta : float or None
        None trains on the squared error.
    weight_decay : float
    device : torch device
    seed : int
        Of the initial weights.

    Raises
    ------
    ValueError
        For widths that are not positive integers.
    """

    def __init__(
        self,
        n_features: int,
        n_targets: int,
        hidden: Sequence[int],
        n_members: int,
        activation: str,
        *,
        nll_beta: float | None,
        weight_decay: float,
        device: torch.device,
        seed: int,
    ) -> None:
        if any(int(width) != width or width < 1 for width in hidden):
            raise ValueError(f"hidden_layer_sizes must be positive integers, got {list(hidden)}.")
        outputs = n_targets if nll_beta is None else 2 * n_targets
        widths = [n_features, *map(int, hidden), outputs]
        self.network = BatchedMLP(widths, n_members, activation, dtype=torch.float32, device=device)
        self.network.initialise(torch.Generator().manual_seed(seed))
        self.loss: Loss = SquaredError()
        if nll_beta is not None:
            self.loss = GaussianNLL(n_members, n_targets, nll_beta, self.network.flat_weights)
        self.optimizer = Adam(self.network, self.loss, weight_decay)

    def resume(
        self,
        weights: list[Singles],
        biases: list[Singles],
        bounds: Singles,
        moments: list[Singles] | None,
    ) -> None:
        """Take up the weights, and perhaps the optimiser's moments, of an earlier run.

        Raises
        ------
        ValueError
            If it was a run of another architecture.
        """
        tensors = [*self.network.weights, *self.network.biases, *self.loss.parameters()]
        fitted: list[NDArray[Any]] = [*weights, *biases, *(bounds if bounds.size else [])]
        if [tuple(tensor.shape) for tensor in tensors] != [value.shape for value in fitted]:
            raise ValueError(
                "hidden_layer_sizes, n_members or probabilistic changed since the last fit, whose "
                "weights were to be trained further; fit a clone, or with warm_start=False."
            )
        for tensor, value in zip(tensors, fitted):
            tensor.copy_(torch.tensor(value))
        if moments is not None:
            self.optimizer.restore(moments)

    def train(
        self, batches: Iterator[Batch], settings: Settings, validation: Validation | None
    ) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
        """Train; see `trajlearn.regressors._training.train`."""
        batches, validation = self.prepared(batches, settings, validation)
        return train(self.network, self.loss, self.optimizer, batches, settings, validation)

    def prepared(
        self, batches: Iterator[Batch], settings: Settings, validation: Validation | None
    ) -> tuple[Iterator[Batch], Validation | None]:
        """What training is to see of batches and held-out rows."""
        return batches, validation

    def weights(self) -> list[Singles]:
        """Weights of the layers (E, in, out)."""
        return [_numpy(weight) for weight in self.network.weights]

    def biases(self) -> list[Singles]:
        """Biases of the layers (E, 1, out)."""
        return [_numpy(bias) for bias in self.network.biases]

    def bounds(self) -> Singles:
        """Lower and upper bound of the log variance (2, E, 1, k); empty for the squared error."""
        bounds = [_numpy(bound) for bound in self.loss.parameters()]
        return np.stack(bounds) if bounds else np.empty((2, 0), dtype=np.float32)


def _numpy(tensor: torch.Tensor) -> Singles:
    array: Singles = tensor.cpu().numpy().copy()
    return array
