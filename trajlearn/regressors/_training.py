"""The training loop: schedule, optimiser, early stopping."""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adamw import adamw

from trajlearn.regressors._batches import Batch
from trajlearn.regressors._losses import Loss
from trajlearn.regressors._network import BatchedMLP
from trajlearn.regressors._threads import threads_for

# held-out rows are evaluated in blocks of this size, which bounds the memory
_VALIDATION_BLOCK = 1024


@dataclass(frozen=True)
class Settings:
    """How long and how fast to train."""

    n_steps: int
    learning_rate: float
    schedule: str
    verbose: bool


@dataclass(frozen=True)
class Validation:
    """Held-out rows (n, d), (n, k) or (E, n, k), (n, 1) or None, and when to give up."""

    x: Tensor
    y: Tensor
    weight: Tensor | None
    patience: int


class Adam:
    """Fused AdamW over a network and its loss; decay acts on the weights alone.

    Calls torch's function: the `Optimizer` around it costs more than the update of a small network
    and imports torch's compiler at its first step.
    """

    def __init__(self, network: BatchedMLP, loss: Loss, weight_decay: float) -> None:
        self._decayed, self.weight_decay = network.flat_weights, weight_decay
        self._tensors = [network.flat_weights, network.flat_biases, *loss.parameters()]
        self._grads = [tensor.grad for tensor in self._tensors if tensor.grad is not None]
        self._first = [torch.zeros_like(tensor) for tensor in self._tensors]
        self._second = [torch.zeros_like(tensor) for tensor in self._tensors]
        self._steps = [torch.zeros((), device=tensor.device) for tensor in self._tensors]

    def step(self, learning_rate: float) -> None:
        """Update every tensor from its gradient."""
        if self.weight_decay:
            self._decayed.mul_(1.0 - learning_rate * self.weight_decay)
        adamw(
            self._tensors,
            self._grads,
            self._first,
            self._second,
            [],
            self._steps,
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    def _state(self) -> list[Tensor]:
        return [*self._steps, *self._first, *self._second]

    def both_moments(self) -> tuple[list[Tensor], list[Tensor]]:
        """First and second moments of the weights, the biases and the loss's own parameters."""
        return self._first, self._second

    def set_steps(self, other: "Adam") -> None:
        """Take as many steps as done as another has."""
        for own, done in zip(self._steps, other._steps):
            own.copy_(done)

    def moments(self) -> list[NDArray[np.float32]]:
        """Step counts and moments of all tensors, to go on later."""
        return [tensor.cpu().numpy().copy() for tensor in self._state()]

    def restore(self, moments: list[NDArray[np.float32]]) -> None:
        """Take up the moments of an earlier run."""
        for tensor, value in zip(self._state(), moments):
            tensor.copy_(torch.tensor(value))


def default_steps(n_rows: int) -> int:
    """Gradient steps that suit a number of rows: 15 n^0.55, from 100 to 4,000."""
    return int(np.clip(15 * n_rows**0.55, 100, 4000))


def learning_rate(step: int, settings: Settings) -> float:
    """Rate of a step: constant, or one cycle (a tenth of warm-up, then a cosine to zero)."""
    if settings.schedule == "constant":
        return settings.learning_rate
    warm = max(settings.n_steps // 10, 1)
    if step < warm:
        start = 1 / 25
        rise = 0.5 * (1 - math.cos(math.pi * (step + 1) / warm))
        return settings.learning_rate * (start + (1 - start) * rise)
    progress = (step - warm) / max(settings.n_steps - warm, 1)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * progress))


def train(
    network: BatchedMLP,
    loss: Loss,
    optimizer: Adam,
    batches: Iterator[Batch],
    settings: Settings,
    validation: Validation | None = None,
) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """Train in place.

    Returns
    -------
    n_steps : int
        Steps taken; fewer than asked for if training stopped early.
    losses : ndarray of shape (about 100, E)
        Training loss at regular steps.
    validation_losses : ndarray of shape (evaluations, E)
        Empty without held-out rows. With them, each member keeps its best weights.
    """
    every = max(settings.n_steps // 100, 1)
    stopper = None if validation is None else _BestWeights(network, loss, validation)
    losses = []
    x, y, weight = next(batches)
    flops = 6 * network.flat_weights.numel() * x.shape[1]
    with threads_for(flops), torch.no_grad(), _progress(settings) as bar:
        for step in range(settings.n_steps):
            if step:
                x, y, weight = next(batches)
            out = network.forward(x)
            if step % every == 0:
                losses.append(loss.value(out, y, weight))
                if bar is not None:
                    bar.set_postfix(loss=f"{losses[-1].mean().item():.3g}", refresh=False)
                    bar.update(step - bar.n)
            network.backward(x, loss.gradient(out, y, weight))
            optimizer.step(learning_rate(step, settings))
            if stopper is not None and (step + 1) % every == 0 and stopper.give_up():
                break
        if bar is not None:
            bar.update(step + 1 - bar.n)
        if stopper is not None:
            stopper.restore()
    history = torch.stack(losses).cpu().numpy().astype(np.float64)
    if stopper is None:
        return step + 1, history, np.empty((0, network.n_members))
    return step + 1, history, torch.stack(stopper.losses).cpu().numpy().astype(np.float64)


def _progress(settings: Settings) -> AbstractContextManager[Any]:
    """Progress bar, or None."""
    if not settings.verbose:
        return nullcontext()
    from tqdm import tqdm

    bar: AbstractContextManager[Any] = tqdm(total=settings.n_steps, desc="training", unit="step")
    return bar


class _BestWeights:
    """Each member's best weights on held-out rows."""

    def __init__(self, network: BatchedMLP, loss: Loss, validation: Validation) -> None:
        self._network, self._loss, self._validation = network, loss, validation
        self._tensors = [*network.weights, *network.biases, *loss.parameters()]
        self._best = [tensor.clone() for tensor in self._tensors]
        self._best_loss = torch.full((network.n_members,), torch.inf)
        self._since = torch.zeros(network.n_members)
        self.losses: list[Tensor] = []

    def give_up(self) -> bool:
        """Evaluate; true when no member has improved within the patience."""
        value = self._held_out_loss().cpu()
        self.losses.append(value)
        better = value < self._best_loss
        self._best_loss = torch.where(better, value, self._best_loss)
        self._since = torch.where(better, 0.0, self._since + 1)
        chosen = better.nonzero()[:, 0]
        for best, tensor in zip(self._best, self._tensors):
            best[chosen] = tensor[chosen]
        return bool((self._since >= self._validation.patience).all())

    def _held_out_loss(self) -> Tensor:
        """Loss of each member (E,) on the held-out rows."""
        held_out = self._validation
        total, n_rows = torch.zeros((), device=held_out.x.device), len(held_out.x)
        for at in range(0, n_rows, _VALIDATION_BLOCK):
            part = slice(at, at + _VALIDATION_BLOCK)
            x = held_out.x[part].expand(self._network.n_members, -1, -1)
            weight = None if held_out.weight is None else held_out.weight[part]
            y = held_out.y[..., part, :]
            value = self._loss.value(self._network.forward(x), y, weight)
            total = total + value * (x.shape[1] / n_rows)
        return total

    def restore(self) -> None:
        """Put the best weights back."""
        for best, tensor in zip(self._best, self._tensors):
            tensor.copy_(best)
