"""A second network for the variance of the residuals, while the one for the mean stays as it is.

With one likelihood for both, a network may leave what is hard to predict to the variance, and
the variance follows residuals that shrink as the mean is fitted (see `nll_beta`). Trained one
after the other, the mean is that of the squared error and the variance that of its residuals.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle, islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajlearn.regressors._batches import Batch
from trajlearn.regressors._ensemble import Ensemble, Singles
from trajlearn.regressors._losses import ResidualNLL
from trajlearn.regressors._network import BatchedMLP
from trajlearn.regressors._prediction import Predictor
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors._training import Adam, Settings, Validation

Floats = NDArray[np.float64]
Columns = tuple[Sequence[int], Sequence[int]]
Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]

# measured on trajectory models: wider networks give no better intervals
_NARROWER, _LEAST_WIDTH = 4, 32
# steps for each batch whose residuals are computed, which takes the larger network
_STEPS_A_BATCH, _LEAST_BATCHES = 16, 50
# held-out rows whose residuals are computed at once
_BLOCK = 1024
# least log variance, from that of the mean squared residual, and the greatest, from the largest
_BELOW, _ABOVE = -10.0, 1.0
# standardised residuals below this are rounding of single precision
_LEAST_STD = 1e-6


def out_of_bag(counts: Floats) -> Floats:
    """Which rows (E, n) a bootstrapped member never saw: 1 or 0; all rows if it saw them all."""
    unseen = counts == 0
    return np.where(unseen.any(axis=1, keepdims=True), unseen, True).astype(np.float64)


class VarianceEnsemble(Ensemble):
    """Networks of the log variance in training, one for each trained mean.

    Their targets are the residuals of standardised targets. They are narrower than the means'.

    Parameters
    ----------
    means : BatchedMLP
        Trained; E networks with k outputs.
    activation : str
    residual_std, residual_peak : ndarray of shape (E, k)
        Standard deviation and greatest size of the residuals: where the log variance starts, and
        what bounds it.
    weight_decay : float
    seed : int
        Of the initial weights.
    """

    def __init__(
        self,
        means: BatchedMLP,
        activation: str,
        *,
        residual_std: Floats,
        residual_peak: Floats,
        weight_decay: float,
        seed: int,
    ) -> None:
        self._means = means
        n_features, *hidden, n_targets = means.sizes
        narrow = [min(width, max(width // _NARROWER, _LEAST_WIDTH)) for width in hidden]
        like = means.flat_weights
        self.network = BatchedMLP(
            [n_features, *narrow, n_targets],
            means.n_members,
            activation,
            dtype=like.dtype,
            device=like.device,
        )
        self.network.initialise(torch.Generator().manual_seed(seed))
        usual, peak = (
            torch.from_numpy(2 * np.log(np.maximum(residual, _LEAST_STD))[:, None]).to(like)
            for residual in (residual_std, residual_peak)
        )
        self.network.biases[-1].copy_(usual)
        self._nll = ResidualNLL(usual + _BELOW, peak + _ABOVE)
        self.loss = self._nll
        self.optimizer = Adam(self.network, self.loss, weight_decay)

    def resume(
        self,
        weights: list[Singles],
        biases: list[Singles],
        bounds: Singles,
        moments: list[Singles] | None,
    ) -> None:
        """Take up the weights, and perhaps the optimiser's moments; bounds only widen."""
        super().resume(weights, biases, bounds[:, :0], moments)
        low, high = torch.tensor(bounds).to(self._nll.low)
        self._nll.low = torch.minimum(self._nll.low, low)
        self._nll.high = torch.maximum(self._nll.high, high)

    def prepared(
        self, batches: Iterator[Batch], settings: Settings, validation: Validation | None
    ) -> tuple[Iterator[Batch], Validation | None]:
        """Batches, and held-out rows, with the residuals of the means for targets."""
        with threads_for(0.0):
            n_kept = max(settings.n_steps // _STEPS_A_BATCH, _LEAST_BATCHES)
            kept = [
                (x.clone(), self._residuals(x, y), weight)
                for x, y, weight in islice(batches, min(n_kept, settings.n_steps))
            ]
            if validation is not None:
                blocks = zip(validation.x.split(_BLOCK), validation.y.split(_BLOCK))
                residuals = [
                    self._residuals(x.expand(self._means.n_members, -1, -1), y) for x, y in blocks
                ]
                validation = replace(validation, y=torch.cat(residuals, dim=1))
        return cycle(kept), validation

    def _residuals(self, x: Tensor, y: Tensor) -> Tensor:
        return y - self._means.forward(x)

    def bounds(self) -> Singles:
        """Lower and upper bound of the log variance (2, E, 1, k)."""
        bounds: Singles = torch.stack([self._nll.low, self._nll.high]).cpu().numpy()
        return bounds


class MeanAndVariance:
    """A predictor of means and one of raw log variances, as one that gives both.

    Parameters
    ----------
    means, log_variances : Predictor
        Of the same inputs.
    """

    def __init__(self, means: Predictor, log_variances: Predictor) -> None:
        self._parts = means, log_variances

    @property
    def n_members(self) -> int:
        """E."""
        return self._parts[0].n_members

    def __call__(self, x: NDArray[Any]) -> Floats:
        """Outputs (E, n, 2k) for rows (n, in)."""
        return np.concatenate([part(x) for part in self._parts], axis=2)

    def own(self, x: NDArray[Any]) -> Floats:
        """Outputs (E, n, 2k) for rows (E, n, in) of each member's own."""
        return np.concatenate([part.own(x) for part in self._parts], axis=2)

    def product(
        self, left: NDArray[Any], right: NDArray[Any], columns: Columns, index: Pairs
    ) -> Floats:
        """Outputs (E, m, 2k) for rows that join rows of `left` and `right`; see `Predictor`."""
        outputs = [part.product(left, right, columns, index) for part in self._parts]
        return np.concatenate(outputs, axis=2)
