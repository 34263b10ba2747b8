"""All members of an ensemble as one network: stacked weights, one batched product a layer.

Forward and backward passes are written out: with small networks the bookkeeping of automatic
differentiation costs as much as the matrix products. `tests/regressors/test_network.py` checks
every gradient against autograd.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

Activation = tuple[Callable[[Tensor, Tensor], None], Callable[[Tensor, Tensor, Tensor], None]]


def _relu(z: Tensor, out: Tensor) -> None:
    torch.clamp_min(z, 0.0, out=out)


def _relu_back(grad: Tensor, z: Tensor, a: Tensor) -> None:
    torch.ops.aten.threshold_backward.grad_input(grad, z, 0.0, grad_input=grad)


def _silu(z: Tensor, out: Tensor) -> None:
    torch.ops.aten.silu.out(z, out=out)


def _silu_back(grad: Tensor, z: Tensor, a: Tensor) -> None:
    torch.ops.aten.silu_backward.grad_input(grad, z, grad_input=grad)


def _tanh(z: Tensor, out: Tensor) -> None:
    torch.tanh(z, out=out)


def _tanh_back(grad: Tensor, z: Tensor, a: Tensor) -> None:
    torch.ops.aten.tanh_backward.grad_input(grad, a, grad_input=grad)


ACTIVATIONS: dict[str, Activation] = {
    "relu": (_relu, _relu_back),
    "silu": (_silu, _silu_back),
    "tanh": (_tanh, _tanh_back),
}


class BatchedMLP:
    """E fully connected networks of the same sizes, trained and evaluated together.

    Parameters
    ----------
    sizes : sequence of int
        Widths, input first, output last.
    n_members : int
    activation : {"relu", "silu", "tanh"}
    dtype, device : torch dtype and device

    Attributes
    ----------
    weights : list of Tensor of shape (E, in, out)
        Views of `flat_weights`.
    biases : list of Tensor of shape (E, 1, out)
        Views of `flat_biases`.
    flat_weights, flat_biases : Tensor
        One vector each, with gradients in `.grad`: the optimiser sees two tensors.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        n_members: int,
        activation: str,
        *,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.sizes, self.n_members, self.activation = tuple(sizes), n_members, activation
        self._act, self._act_back = ACTIVATIONS[activation]
        shapes = [(n_members, a, b) for a, b in pairwise(sizes)]
        self.flat_weights, self.weights, self._grad_w = _flat(shapes, dtype, device)
        shapes = [(n_members, 1, b) for b in sizes[1:]]
        self.flat_biases, self.biases, self._grad_b = _flat(shapes, dtype, device)
        self._buffers: dict[int, list[Tensor]] = {}

    def layers_of(self, flat: Tensor, layers: Sequence[Tensor]) -> list[Tensor]:
        """Views of a vector like `flat_weights` (`flat_biases`) in the shapes of the layers'."""
        parts = flat.split([layer.numel() for layer in layers])
        return [part.view(layer.shape) for part, layer in zip(parts, layers)]

    def initialise(self, generator: torch.Generator) -> None:
        """Draw weights and biases from U(-1/sqrt(in), 1/sqrt(in)), as torch's Linear does."""
        for weight, bias in zip(self.weights, self.biases):
            bound = weight.shape[1] ** -0.5
            for tensor in (weight, bias):
                drawn = torch.rand(tensor.shape, generator=generator, dtype=torch.float64)
                tensor.copy_((2 * drawn - 1) * bound)

    def _activations(self, batch: int) -> list[Tensor]:
        """Buffers of (pre-activation, activation, gradient) for a batch size, made once."""
        if batch not in self._buffers:
            like = self.flat_weights
            self._buffers[batch] = [
                torch.empty((self.n_members, batch, size), dtype=like.dtype, device=like.device)
                for size in self.sizes[1:]
                for _ in range(3)
            ]
        return self._buffers[batch]

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (E, B, out) for inputs (E, B, in); valid until the next call."""
        buffers, last = self._activations(x.shape[1]), len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases)):
            z, a = buffers[3 * i], buffers[3 * i + 1]
            torch.baddbmm(bias, x, weight, out=z)
            if i == last:
                return z
            self._act(z, a)
            x = a
        raise AssertionError("a network has at least one layer")  # pragma: no cover

    def backward(self, x: Tensor, grad: Tensor) -> None:
        """Fill the gradients from that of the loss in the outputs of ``forward(x)``."""
        buffers = self._activations(x.shape[1])
        for i in range(len(self.weights) - 1, -1, -1):
            a_in = buffers[3 * (i - 1) + 1] if i else x
            torch.bmm(a_in.transpose(1, 2), grad, out=self._grad_w[i])
            torch.sum(grad, dim=1, keepdim=True, out=self._grad_b[i])
            if i:
                below = buffers[3 * (i - 1) + 2]
                torch.bmm(grad, self.weights[i].transpose(1, 2), out=below)
                self._act_back(below, buffers[3 * (i - 1)], a_in)
                grad = below


def _flat(
    shapes: Sequence[tuple[int, ...]], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """One vector with a gradient, and views of both in the given shapes."""
    counts = [a * b * c for a, b, c in shapes]
    flat = torch.zeros(sum(counts), dtype=dtype, device=device)
    flat.grad = torch.zeros_like(flat)
    parts = zip(flat.split(counts), shapes)
    grads = zip(flat.grad.split(counts), shapes)
    return flat, [p.view(shape) for p, shape in parts], [g.view(shape) for g, shape in grads]
