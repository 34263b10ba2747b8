"""A recurrent network of sequences: trained on padded batches, evaluated one step at a time."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pad

from trajlearn.regressors._losses import Loss
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors._training import Settings, learning_rate

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

# sequences evaluated at once: always this many rows, so that a row gets the same bits in any batch
BLOCK = 64
# hidden units and outputs are padded to whole vectors: with some odd widths of a matrix product
# the bits of a row depend on its place in the block
_LANES = 16
# a long sequence now and then has a gradient that would undo the training
_MAX_GRADIENT_NORM = 1.0


class SequenceNetwork(nn.Module):
    """LSTM layers and a linear head, initialised from U(-1/sqrt(hidden_size), 1/sqrt(...))."""

    def __init__(
        self, n_inputs: int, n_outputs: int, hidden_size: int, n_layers: int, *, seed: int
    ) -> None:
        super().__init__()
        # the global generator stays as it was
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.lstm = nn.LSTM(n_inputs, hidden_size, n_layers, batch_first=True)
            self.head = nn.Linear(hidden_size, n_outputs)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Outputs (n_real, width) of padded sequences (B, T, k) at the steps in `mask` (B, T)."""
        out: Tensor = self.head(self.lstm(x)[0][mask])
        return out

    def weights(self) -> dict[str, Singles]:
        """Weights by name."""
        return {key: value.cpu().numpy().copy() for key, value in self.state_dict().items()}


@dataclass(frozen=True)
class Sequences:
    """Sequences one after the other: inputs (n_rows, k), targets (n_rows, d), first row of each."""

    inputs: Tensor
    targets: Tensor
    offsets: NDArray[np.intp]

    @cached_property
    def lengths(self) -> NDArray[np.intp]:
        """Rows of each sequence."""
        return np.diff(self.offsets)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def padded(
        self, chosen: NDArray[np.intp], window: int | None, rng: np.random.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Padded inputs (B, T, k), targets of the real steps (n_real, d) and their mask (B, T).

        With a `window`, a random stretch of at most that many steps of each sequence.
        """
        begin, lengths = self.offsets[chosen], self.lengths[chosen]
        if window is not None:
            steps = np.minimum(lengths, window)
            begin = begin + rng.integers(lengths - steps + 1)
            lengths = steps
        reach = np.arange(lengths.max())
        mask = reach < lengths[:, None]
        index = torch.from_numpy(np.where(mask, begin[:, None] + reach, begin[:, None]))
        real = torch.from_numpy(mask)
        device = self.inputs.device
        rows = index[real].to(device)
        return self.inputs[index.to(device)], self.targets[rows], real.to(device)

    def batches(
        self, batch_size: int, window: int | None, rng: np.random.Generator
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Padded batches without end: every sequence once an epoch, in a new order each."""
        while True:
            order = rng.permutation(len(self))
            for at in range(0, len(order), batch_size):
                yield self.padded(order[at : at + batch_size], window, rng)


def train(
    network: SequenceNetwork,
    loss: Loss,
    batches: Iterator[tuple[Tensor, Tensor, Tensor]],
    settings: Settings,
    *,
    weight_decay: float,
) -> Floats:
    """Train in place with teacher forcing; returns the loss at about 100 regular steps."""
    from tqdm.auto import tqdm

    parameters = list(network.parameters())
    weights = [p for name, p in network.named_parameters() if "weight" in name]
    others = [p for name, p in network.named_parameters() if "weight" not in name]
    optimizer = torch.optim.AdamW(
        [
            {"params": weights, "weight_decay": weight_decay},
            {"params": [*others, *loss.parameters()], "weight_decay": 0.0},
        ],
        fused=True,
    )
    every, losses = max(settings.n_steps // 100, 1), []
    bar = tqdm(total=settings.n_steps, disable=not settings.verbose, desc="training", unit="step")
    # the steps of a sequence follow one another, so each product is small whatever the batch
    with threads_for(0.0), bar:
        for step in range(settings.n_steps):
            x, y, mask = next(batches)
            out = network(x, mask)
            with torch.no_grad():
                grad = loss.gradient(out.detach()[None], y[None], None)
                if step % every == 0:
                    losses.append(loss.value(out.detach()[None], y[None], None)[0])
            # the loss has filled in the gradients of its own parameters
            for parameter in parameters:
                parameter.grad = None
            out.backward(grad[0])
            nn.utils.clip_grad_norm_(parameters, _MAX_GRADIENT_NORM)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(step, settings)
            optimizer.step()
            bar.update()
    return torch.stack(losses).cpu().numpy().astype(np.float64)


class Stepper:
    """Evaluates a trained network one step at a time for m sequences, keeping their memory.

    Parameters
    ----------
    weights : mapping from name to ndarray
        As `SequenceNetwork.weights` gives them.
    n_sequences : int
    device : torch device
    """

    def __init__(
        self, weights: Mapping[str, NDArray[Any]], n_sequences: int, device: torch.device
    ) -> None:
        self._device = device
        self._n_outputs = len(weights["head.bias"])
        self._cells: list[tuple[Tensor, Tensor, Tensor]] = []
        while f"lstm.weight_ih_l{len(self._cells)}" in weights:
            i = len(self._cells)
            into, hidden = (weights[f"lstm.weight_{kind}_l{i}"] for kind in ("ih", "hh"))
            bias = weights[f"lstm.bias_ih_l{i}"] + weights[f"lstm.bias_hh_l{i}"]
            columns = into.shape[1] + (-into.shape[1] % _LANES if i else 0)
            width = hidden.shape[1] + -hidden.shape[1] % _LANES
            self._cells.append(
                (
                    self._gates(into, columns).T.contiguous(),
                    self._gates(hidden, width).T.contiguous(),
                    self._gates(bias[:, None], 1)[:, 0].contiguous(),
                )
            )
        head, bias = self._tensor(weights["head.weight"]), self._tensor(weights["head.bias"])
        beside = -len(bias) % _LANES
        self._head = (
            pad(head, (0, width - head.shape[1], 0, beside)).T.contiguous(),
            pad(bias, (0, beside)),
        )
        self._blocks = math.ceil(n_sequences / BLOCK)
        shape = (len(self._cells), self._blocks * BLOCK, width)
        self._h = torch.zeros(shape, device=device)
        self._c = torch.zeros(shape, device=device)
        self._n = n_sequences

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self._device)

    def _gates(self, weight: NDArray[Any], columns: int) -> Tensor:
        """Weights (4 * hidden, k) of the four gates, each padded with idle units."""
        gates = self._tensor(weight).unflatten(0, (4, -1))
        above = -gates.shape[1] % _LANES
        return pad(gates, (0, columns - gates.shape[2], 0, above)).flatten(0, 1)

    def repeated(self, copies: int) -> "Stepper":
        """A stepper for `copies` times the sequences, each copy with the memory of its original."""
        new = object.__new__(Stepper)
        vars(new).update(vars(self))
        new._n = copies * self._n
        new._blocks = math.ceil(new._n / BLOCK)
        beyond = new._blocks * BLOCK - new._n
        new._h, new._c = (
            pad(memory[:, : self._n].repeat(1, copies, 1), (0, 0, 0, beyond))
            for memory in (self._h, self._c)
        )
        return new

    def step(self, inputs: Floats, active: NDArray[np.bool_] | None = None) -> Floats:
        """Outputs (m, width) for inputs (m, k); memories change only where `active` (m,)."""
        padded = np.zeros((self._blocks * BLOCK, inputs.shape[1]), dtype=np.float32)
        with np.errstate(over="ignore"):
            padded[: self._n] = inputs
        rows = torch.from_numpy(padded).to(self._device)
        moving = None
        if active is not None:
            moving = torch.zeros((len(rows), 1), dtype=torch.bool)
            moving[: self._n, 0] = torch.from_numpy(active)
            moving = moving.to(self._device)
        out = torch.empty((len(rows), self._n_outputs), device=self._device)
        with torch.inference_mode(), threads_for(0.0):
            for at in range(0, len(rows), BLOCK):
                block = slice(at, at + BLOCK)
                x = self._advance(rows[block], block, None if moving is None else moving[block])
                out[block] = torch.addmm(self._head[1], x, self._head[0])[:, : self._n_outputs]
        return out[: self._n].cpu().numpy().astype(np.float64)

    def _advance(self, x: Tensor, block: slice, moving: Tensor | None) -> Tensor:
        """Last layer's hidden units (BLOCK, width) of a block, whose memories move on."""
        for i, (w_in, w_hidden, bias) in enumerate(self._cells):
            h_before, c_before = self._h[i, block], self._c[i, block]
            gates = torch.addmm(torch.addmm(bias, x, w_in), h_before, w_hidden)
            update, forget, candidate, output = gates.chunk(4, dim=1)
            c = torch.sigmoid(forget) * c_before + torch.sigmoid(update) * torch.tanh(candidate)
            h = torch.sigmoid(output) * torch.tanh(c)
            x = h
            if moving is not None:
                c, h = torch.where(moving, c, c_before), torch.where(moving, h, h_before)
            self._c[i, block], self._h[i, block] = c, h
        return x
