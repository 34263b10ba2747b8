"""Evaluating an ensemble on many rows: fixed-size padded blocks that stay in cache.

Every matrix product has the same shape whatever the number of rows, on one thread, so a row gets
the same bits alone, in a batch, in any order, with any number of workers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from trajlearn.regressors._network import ACTIVATIONS
from trajlearn.regressors._threads import threads_for

Floats = NDArray[np.float64]

BLOCK = 128
# Widths are padded to whole vectors: with some odd widths (5 to 7, 9 to 11 outputs) the bits of a
# row depend on its place in the block, and few outputs cost twice the time.
LANES = 16


class Predictor:
    """Outputs of all members for rows of inputs.

    Parameters
    ----------
    weights : sequence of ndarray of shape (E, in, out)
    biases : sequence of ndarray of shape (E, 1, out)
    activation : str
    device : torch device
    output_scale, output_shift : ndarray of shape (out,)
        What comes out is ``y * output_scale + output_shift``, in float64.
    """

    def __init__(
        self,
        weights: Sequence[NDArray[Any]],
        biases: Sequence[NDArray[Any]],
        activation: str,
        *,
        device: torch.device,
        output_scale: Floats,
        output_shift: Floats,
    ) -> None:
        self._n_outputs = weights[-1].shape[2]
        self._weights = [_tensor(w, device) for w in weights]
        self._biases = [_tensor(b, device) for b in biases]
        for i, (weight, bias) in enumerate(zip(self._weights, self._biases)):
            above = -weight.shape[1] % LANES if i else 0
            beside = -weight.shape[2] % LANES
            self._weights[i] = pad(weight, (0, beside, 0, above))
            self._biases[i] = pad(bias, (0, beside))
        self._act = ACTIVATIONS[activation][0]
        self._output = output_scale, output_shift
        self._hidden = [
            torch.empty((len(w), BLOCK, w.shape[2]), dtype=w.dtype, device=device)
            for w in self._weights
        ]

    @property
    def n_members(self) -> int:
        """E."""
        return len(self._weights[0])

    def __call__(self, x: NDArray[Any]) -> Floats:
        """Outputs (E, n, out) for rows (n, in)."""
        rows = self._to_device(x)
        first, bias = self._weights[0], self._biases[0]

        def layer(block: slice, out: Tensor) -> None:
            torch.baddbmm(bias, rows[block].expand(self.n_members, -1, -1), first, out=out)

        return self._run(len(x), layer)

    def own(self, x: NDArray[Any]) -> Floats:
        """Outputs (E, n, out) of each member for rows of its own (E, n, in)."""
        n, width = x.shape[1:]
        # by blocks, so that each lies in memory the same way however many there are
        rows = np.zeros((-(-n // BLOCK), self.n_members, BLOCK, width), dtype=np.float32)
        with np.errstate(over="ignore"):
            for block, at in zip(rows, range(0, n, BLOCK)):
                block[:, : n - at] = x[:, at : at + BLOCK]
        blocks = torch.from_numpy(rows).to(self._weights[0].device)
        first, bias = self._weights[0], self._biases[0]

        def layer(block: slice, out: Tensor) -> None:
            torch.baddbmm(bias, blocks[block.start // BLOCK], first, out=out)

        return self._run(n, layer)

    def product(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        columns: tuple[Sequence[int], Sequence[int]],
        index: tuple[NDArray[np.intp], NDArray[np.intp]],
    ) -> Floats:
        """Outputs (E, m, out) for rows that join rows of `left` and of `right`.

        Row i joins ``left[index[0][i]]``, which holds the columns ``columns[0]`` of the inputs,
        with ``right[index[1][i]]``, which holds ``columns[1]``. The first layer is computed once
        for each row of `left` and of `right` and added, which saves its matrix product for every
        pair: many candidates times many horizons.
        """
        halves = [self._half(left, columns[0]), self._half(right, columns[1])]
        halves[0] += self._biases[0]
        which = [_padded(torch.tensor(i)).to(halves[0].device) for i in index]
        scratch = torch.empty_like(self._hidden[0])

        def layer(block: slice, out: Tensor) -> None:
            torch.index_select(halves[0], 1, which[0][block], out=out)
            torch.index_select(halves[1], 1, which[1][block], out=scratch)
            out += scratch

        return self._run(len(index[0]), layer)

    def _half(self, x: NDArray[Any], columns: Sequence[int]) -> Tensor:
        """First-layer product (E, n, width) of some of the columns, without the bias."""
        weight = self._weights[0][:, torch.tensor(columns, dtype=torch.long)]
        rows = self._to_device(x)
        half = rows.new_empty((self.n_members, len(rows), weight.shape[2]))
        with threads_for(0.0):
            for at in range(0, len(rows), BLOCK):
                block = rows[at : at + BLOCK].expand(self.n_members, -1, -1)
                half[:, at : at + BLOCK] = torch.bmm(block, weight)
        return half

    def _run(self, n_rows: int, first_layer: Any) -> Floats:
        """Loop over blocks; `first_layer` fills the first pre-activation of a block."""
        last = len(self._weights) - 1
        collected = torch.empty((self.n_members, n_rows, self._n_outputs))
        with threads_for(0.0), torch.inference_mode():
            for at in range(0, n_rows, BLOCK):
                a = self._hidden[0]
                first_layer(slice(at, at + BLOCK), a)
                for i in range(1, last + 1):
                    self._act(a, a)
                    torch.baddbmm(self._biases[i], a, self._weights[i], out=self._hidden[i])
                    a = self._hidden[i]
                collected[:, at : at + BLOCK] = a[:, : n_rows - at, : self._n_outputs]
        scale, shift = self._output
        return collected.numpy().astype(np.float64) * scale + shift

    def _to_device(self, x: NDArray[Any]) -> Tensor:
        rows = np.zeros((len(x) + -len(x) % BLOCK, x.shape[1]), dtype=np.float32)
        with np.errstate(over="ignore"):
            rows[: len(x)] = x
        return torch.from_numpy(rows).to(self._weights[0].device)


def bounded(raw: Floats, low: Floats, high: Floats) -> Floats:
    """Smooth clamp of a raw log variance, as in training.

    In numpy: torch's vectorised softplus and its remainder loop differ in the last bit, by place.
    """
    upper = high - _softplus(high - raw)
    return low + _softplus(upper - low)


def _softplus(x: Floats) -> Floats:
    return np.maximum(x, 0.0) + np.log1p(np.exp(-np.abs(x)))


def mixture(means: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Mean and variance (n, out) of the mixture of all members (E, n, out).

    Members are added one after another: numpy's `mean` adds a single row in another order.
    """
    mean = mean_of_members(means)
    return mean, mean_of_members(variances) + mean_of_members((means - mean) ** 2)


def mean_of_members(values: Floats) -> Floats:
    """Mean over the first axis, the same bits however many rows follow."""
    total = values[0].copy()
    for member in values[1:]:
        total += member
    return total / len(values)


def _tensor(array: NDArray[Any], device: torch.device) -> Tensor:
    return torch.tensor(array, dtype=torch.float32, device=device)


def _padded(rows: Tensor) -> Tensor:
    """Zero rows appended up to whole blocks."""
    missing = -len(rows) % BLOCK
    if not missing:
        return rows
    return torch.cat([rows, rows.new_zeros((missing, *rows.shape[1:]))])
