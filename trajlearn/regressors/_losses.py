"""Losses of an ensemble's outputs and their gradients, written out.

All are a sum over members of a mean over rows and targets, so that a member learns as it would
alone. Checked against autograd in the tests.
"""

from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import softplus

# standardised targets: start between a variance far below any fit and one near the data's own
_INITIAL_BOUNDS = (-10.0, 0.5)
_BOUND_PENALTY = 0.01


class Loss(Protocol):
    """What training asks of a loss."""

    def gradient(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        """Gradient in the outputs (E, B, width); also fills those of the loss's own parameters."""

    def value(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        """Loss of each member (E,)."""

    def parameters(self) -> list[Tensor]:
        """The loss's own trained parameters."""


def _mean(terms: Tensor, weight: Tensor | None) -> Tensor:
    return (terms if weight is None else terms * weight).mean(dim=(1, 2))


class SquaredError:
    """Mean squared error."""

    def gradient(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        grad = out - y
        grad *= 2.0 / (out.shape[1] * out.shape[2])
        return grad if weight is None else grad.mul_(weight)

    def value(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        return _mean((out - y) ** 2, weight)

    def parameters(self) -> list[Tensor]:
        return []


class GaussianNLL:
    r"""Gaussian negative log likelihood with trained variance bounds (beta-NLL for beta > 0).

    The first half of the outputs is the mean m, the second a raw log variance that a smooth
    clamp keeps between trained bounds (Chua et al. 2018). Each term
    :math:`\tfrac12 (\log\sigma^2 + (m - y)^2 / \sigma^2)` is weighted by
    :math:`\sigma^{2\beta}`, held constant (Seitzer et al. 2022).
    """

    def __init__(self, n_members: int, n_targets: int, beta: float, like: Tensor) -> None:
        self.beta = beta
        low, high = _INITIAL_BOUNDS
        shape = (n_members, 1, n_targets)
        self.min_logvar = torch.full(shape, low, dtype=like.dtype, device=like.device)
        self.max_logvar = torch.full(shape, high, dtype=like.dtype, device=like.device)
        for bound in self.parameters():
            bound.grad = torch.zeros_like(bound)

    def parameters(self) -> list[Tensor]:
        return [self.min_logvar, self.max_logvar]

    def split(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and bounded log variance (E, B, n_targets) each."""
        mean, raw = out.chunk(2, dim=2)
        return mean, bounded(raw, self.min_logvar, self.max_logvar)

    def gradient(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        mean, raw = out.chunk(2, dim=2)
        upper, logvar = _clamped(raw, self.min_logvar, self.max_logvar)
        precision = torch.exp(-logvar)
        error = mean - y
        scale = torch.exp(self.beta * logvar) / y[0].numel()
        if weight is not None:
            scale = scale * weight
        grad = torch.empty_like(out)
        torch.mul(error * precision, scale, out=grad[..., : y.shape[2]])
        in_logvar = 0.5 * scale * (1.0 - error**2 * precision)
        below_max = torch.sigmoid(self.max_logvar - raw)
        above_min = torch.sigmoid(upper - self.min_logvar)
        in_upper = in_logvar * above_min
        torch.mul(in_upper, below_max, out=grad[..., y.shape[2] :])
        # without a pull inwards the bounds would drift off and clamp nothing
        pull = _BOUND_PENALTY / y.shape[2]
        _fill(self.min_logvar, (in_logvar - in_upper).sum(1, keepdim=True) - pull)
        _fill(self.max_logvar, (in_upper * (1.0 - below_max)).sum(1, keepdim=True) + pull)
        return grad

    def value(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        mean, logvar = self.split(out)
        terms = 0.5 * (logvar + (mean - y) ** 2 * torch.exp(-logvar))
        return _mean(terms, weight)


class ResidualNLL:
    r"""Gaussian negative log likelihood of residuals, in their log variance alone.

    The outputs are raw log variances, which a smooth clamp keeps between bounds (E, 1, k).
    """

    def __init__(self, low: Tensor, high: Tensor) -> None:
        self.low, self.high = low, high

    def parameters(self) -> list[Tensor]:
        return []

    def gradient(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        upper, logvar = _clamped(out, self.low, self.high)
        grad = 1.0 - y**2 * torch.exp(-logvar)
        grad *= torch.sigmoid(self.high - out) * torch.sigmoid(upper - self.low)
        grad *= 0.5 / y[0].numel()
        return grad if weight is None else grad.mul_(weight)

    def value(self, out: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        logvar = bounded(out, self.low, self.high)
        return _mean(0.5 * (logvar + y**2 * torch.exp(-logvar)), weight)


def _fill(parameter: Tensor, gradient: Tensor) -> None:
    assert parameter.grad is not None  # made with the parameter
    parameter.grad.copy_(gradient)


def bounded(raw: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Smooth clamp of a raw log variance."""
    return _clamped(raw, low, high)[1]


def _clamped(raw: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Clamped from above alone, and from both sides; gradients need the first, too."""
    upper = high - softplus(high - raw)
    return upper, low + softplus(upper - low)
