"""Batches for training: all rows, rows in a random order, or fresh rows of a stream."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajlearn.regressors._samples import Rows

Floats = NDArray[np.float64]
# inputs (E, B, d), standardised targets (E, B, k), weights (E, B, 1) of mean 1 or None
Batch = tuple[Tensor, Tensor, Tensor | None]
Draw = Callable[[int, np.random.Generator], tuple[Floats, Floats, Floats | None]]

# steps for which row numbers, or rows of a stream, are drawn at once: the Python around it vanishes
_STEPS_A_DRAW = 64


@dataclass(frozen=True)
class ToTensors:
    """Single-precision tensors of rows: inputs, standardised targets, weights of mean 1."""

    target_mean: Floats
    target_scale: Floats
    device: torch.device

    def __call__(self, X: Floats, y: Floats, weight: Floats | None) -> Batch:
        """(n, d), (n, k) or (n,), (n,) or (E, n) -> (n, d), (n, k), (n, 1) or (E, n, 1)."""
        y = y[:, None] if y.ndim == 1 else y
        targets = (y - self.target_mean) / self.target_scale
        if weight is None:
            return self._tensor(X), self._tensor(targets), None
        share = weight / weight.mean(axis=-1, keepdims=True)
        return self._tensor(X), self._tensor(targets), self._tensor(share[..., None])

    def _tensor(self, values: Floats) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self.device)


def row_batches(
    rows: Rows,
    counts: Floats | None,
    to_tensors: ToTensors,
    n_members: int,
    batch_size: int,
    rng: np.random.Generator,
) -> Iterator[Batch]:
    """All rows at every step if they fit into one batch, else drawn batches.

    `counts` (E, n) says how often a member sees a row; None: as its weight says.
    """
    weight = rows.weight
    if counts is not None:
        weight = counts if weight is None else counts * weight
    if len(rows) <= batch_size:
        return full_batches(*to_tensors(rows.X, rows.y, weight), n_members)
    if weight is not None:
        weight = np.broadcast_to(weight, (n_members, len(rows)))
    x, y, _ = to_tensors(rows.X, rows.y, None)
    return drawn_batches(x, y, weight, n_members, batch_size, rng)


def full_batches(x: Tensor, y: Tensor, weight: Tensor | None, n_members: int) -> Iterator[Batch]:
    """All rows (n, d), (n, k), (n, 1) or (E, n, 1) at every step."""
    shape = (n_members, -1, -1)
    batch = x.expand(shape).contiguous(), y.expand(shape).contiguous(), weight
    while True:
        yield batch


def drawn_batches(
    x: Tensor,
    y: Tensor,
    multiplicity: Floats | None,
    n_members: int,
    batch_size: int,
    rng: np.random.Generator,
) -> Iterator[Batch]:
    """Batches of rows in an order of each member's own.

    Every row once an epoch; with a `multiplicity` (E, n), rows in proportion to it.
    """
    size = (n_members, batch_size)
    x_batch = torch.empty((n_members * batch_size, x.shape[1]), dtype=x.dtype, device=x.device)
    y_batch = torch.empty((n_members * batch_size, y.shape[1]), dtype=y.dtype, device=x.device)
    for block in _row_numbers(len(x), multiplicity, n_members, batch_size, rng):
        numbers = torch.from_numpy(block).to(x.device)
        for step in range(numbers.shape[0]):
            torch.index_select(x, 0, numbers[step], out=x_batch)
            torch.index_select(y, 0, numbers[step], out=y_batch)
            yield x_batch.view(*size, -1), y_batch.view(*size, -1), None


def _row_numbers(
    n_rows: int,
    multiplicity: Floats | None,
    n_members: int,
    batch_size: int,
    rng: np.random.Generator,
) -> Iterator[NDArray[np.int64]]:
    """Row numbers (steps, E * B), many steps at a time."""
    wanted = _STEPS_A_DRAW * batch_size
    shape = (n_members, _STEPS_A_DRAW, batch_size)
    if multiplicity is not None:
        cumulative = np.cumsum(multiplicity, axis=1)
        while True:
            u = rng.random((n_members, wanted)) * cumulative[:, -1:]
            rows = [np.searchsorted(c, v, side="right") for c, v in zip(cumulative, u)]
            yield _by_step(np.minimum(np.stack(rows), n_rows - 1), shape)
    left = np.empty((n_members, 0), dtype=np.int64)
    while True:
        while left.shape[1] < wanted:
            epoch = rng.permuted(np.tile(np.arange(n_rows), (n_members, 1)), axis=1)
            left = np.concatenate([left, epoch], axis=1)
        yield _by_step(left[:, :wanted], shape)
        left = left[:, wanted:]


def _by_step(rows: NDArray[np.int64], shape: tuple[int, int, int]) -> NDArray[np.int64]:
    return np.ascontiguousarray(rows.reshape(shape).swapaxes(0, 1)).reshape(shape[1], -1)


def stream_batches(
    pool: Callable[[int], Batch], n_members: int, batch_size: int
) -> Iterator[Batch]:
    """Rows never seen before at every step: ``pool(n)`` gives n of them, (n, d), (n, k), (n, 1)."""
    size, per_step = (n_members, batch_size, -1), n_members * batch_size
    while True:
        x, y, weight = pool(_STEPS_A_DRAW * per_step)
        for at in range(0, len(x), per_step):
            rows = slice(at, at + per_step)
            w = None if weight is None else weight[rows].view(size)
            yield x[rows].view(size), y[rows].view(size), w


def checked_draw(
    draw: Draw, n_rows: int, rng: np.random.Generator, widths: tuple[int, int] | None = None
) -> tuple[Floats, Floats, Floats | None]:
    """Rows of a stream.

    Raises
    ------
    ValueError
        If their shapes are not those asked for (`widths`: of X and y, if known).
    """
    X, y, weight = draw(n_rows, rng)
    X, y = np.asarray(X), np.asarray(y)
    weight = None if weight is None else np.asarray(weight)
    d, k = widths or (X.shape[-1], y.shape[1] if y.ndim > 1 else 1)
    fits = X.shape == (n_rows, d) and (y.shape == (n_rows, k) or (k == 1 and y.shape == (n_rows,)))
    if not fits or (weight is not None and weight.shape != (n_rows,)):
        shapes = [None if part is None else part.shape for part in (X, y, weight)]
        raise ValueError(
            f"draw({n_rows}, rng) must give X of shape ({n_rows}, {d}), y of shape ({n_rows}, {k}) "
            f"and {n_rows} weights or None; it gave {shapes}."
        )
    return X, y, weight
