"""Linear Gaussian filtering and smoothing of many episodes at once.

filterpy runs one filter over one episode; here B filters of one form run over n episodes
together, because maximum likelihood asks for some hundred passes. Every number comes from
additions, products and quotients of single elements, never from a matrix product of the
library: an estimate has the same bits whatever stands beside it or after it in the arrays.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bank", "Grid", "combine", "filtered", "innovations", "smoothed", "standardised"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Grid:
    """Episodes side by side, padded to the longest of L states."""

    rows: NDArray[np.intp]
    """Row of each state in the dataset (L, n); the last one is repeated as padding."""
    known: NDArray[np.bool_]
    """Which are no padding (L, n)."""
    dt: Floats
    """Time since the state before (L - 1, n)."""

    @classmethod
    def of(cls, first: NDArray[np.intp], counts: NDArray[np.intp], times: Floats) -> "Grid":
        """Stretches of `counts` states, each from the row `first` on."""
        index = np.arange(counts.max())[:, None]
        rows = first + np.minimum(index, counts - 1)
        known = index < counts
        dt = np.diff(times[rows], axis=0)
        dt = np.where(known[1:], dt, dt[:1])
        return cls(rows, known, dt)


@dataclass(frozen=True, eq=False)
class Bank:
    """B filters of one form: hidden z (m,), measured y = H z + e (d,) with independent e."""

    transition: Floats
    """F of each step (L - 1, n, m, m)."""
    process: Floats
    """Covariance of the process noise of each step at intensity 1, of F's shape."""
    measurement: Floats
    """H (d, m)."""
    intensity: Floats
    """Factor of `process` (B,)."""
    variance: Floats
    """Of the measurement errors (B, d)."""
    mean: Floats
    """Of the first hidden state (B, m) or (B, n, m)."""
    covariance: Floats
    """Of the first hidden state (B, m, m)."""
    told: bool = False
    """Whether mean and covariance take account of the first measurement already."""


@dataclass(frozen=True, eq=False)
class _Step:
    mean: Floats
    covariance: Floats
    innovations: list[tuple[Floats, Floats, Floats]]
    """Of each measured number: y - H z (B, n), its variance, the gain (B, n, m)."""


def filtered(bank: Bank, measured: Floats) -> Floats:
    """Hidden states given the measurements up to each time.

    Parameters
    ----------
    bank : Bank
    measured : ndarray of shape (L, B, n, d)
        B may be 1.

    Returns
    -------
    ndarray of shape (L, B, n, m)
    """
    return np.stack([step.mean for step in _forward(bank, measured)])


def innovations(bank: Bank, measured: Floats, counted: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Sums over the `counted` (L, n) states of log S and of v^2 / S (B,), v and S by number.

    With them -2 log likelihood = N log(2 pi) + the first + the second.
    """
    log_variance = np.zeros(len(bank.intensity))
    squares = np.zeros(len(bank.intensity))
    for step, use in zip(_forward(bank, measured), counted, strict=True):
        if not use.any():
            continue
        for error, variance, _ in step.innovations:
            error, variance = error[:, use], variance[:, use]
            log_variance += np.log(variance).sum(axis=1)
            squares += (error * error / variance).sum(axis=1)
    return log_variance, squares


def standardised(bank: Bank, measured: Floats) -> Floats:
    """Innovations over their standard deviations (L, B, n, d)."""
    return np.stack(
        [
            np.stack([error / np.sqrt(variance) for error, variance, _ in step.innovations], -1)
            for step in _forward(bank, measured)
        ]
    )


def smoothed(bank: Bank, measured: Floats, known: NDArray[np.bool_]) -> Floats:
    """Hidden states given all measurements: those of Rauch, Tung and Striebel.

    In the form of Bryson and Frazier, which needs no inverse of a covariance.

    References
    ----------
    G. J. Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18
    (1973) 65-75.
    """
    steps = list(_forward(bank, measured))
    states = np.empty((len(steps), *steps[-1].mean.shape))
    adjoint = np.zeros_like(steps[-1].mean)
    for t in range(len(steps) - 1, -1, -1):
        step = steps[t]
        if t + 1 < len(steps):
            adjoint = _apply(np.swapaxes(bank.transition[t], -1, -2), adjoint)
            adjoint = np.where(known[t + 1][:, None], adjoint, 0.0)
        states[t] = step.mean - _apply(step.covariance, adjoint)
        for row, (error, variance, gain) in zip(bank.measurement[::-1], step.innovations[::-1]):
            weight = error / variance + (gain * adjoint).sum(axis=-1)
            adjoint = adjoint - weight[..., None] * row
    return states


def combine(values: Floats, rows: Floats) -> Floats:
    """``values @ rows.T`` (..., k) of vectors (..., m) and rows (k, m), element by element."""
    return np.stack([_dot(values, row) for row in rows], axis=-1)


def _forward(bank: Bank, measured: Floats) -> Iterator[_Step]:
    n = measured.shape[2]
    n_filters, size = len(bank.intensity), bank.measurement.shape[1]
    unit = np.eye(size)
    first = bank.mean if bank.mean.ndim == 3 else bank.mean[:, None]
    mean: Floats = np.broadcast_to(first, (n_filters, n, size))
    shape = (n_filters, n, size, size)
    covariance: Floats = np.broadcast_to(bank.covariance[:, None], shape)
    for t, values in enumerate(measured):
        if t:
            transition = bank.transition[t - 1]
            mean = _apply(transition, mean)
            covariance = _product(transition, covariance)
            covariance = _product(covariance, np.swapaxes(transition, -1, -2))
            covariance = covariance + bank.intensity[:, None, None, None] * bank.process[t - 1]
        found = []
        # numbers with independent errors may come in one after the other: no inverse
        for i, row in enumerate(bank.measurement if t or not bank.told else ()):
            spread = _dot(covariance, row)
            variance = _dot(spread, row) + bank.variance[:, None, i]
            gain = spread / variance[..., None]
            error = values[..., i] - _dot(mean, row)
            mean = mean + gain * error[..., None]
            # Joseph's form stays positive where next to nothing is left of a vague prior
            keep = unit - gain[..., :, None] * row
            covariance = _product(keep, covariance)
            covariance = _product(covariance, np.swapaxes(keep, -1, -2))
            weighted = gain * bank.variance[:, None, i, None]
            covariance = covariance + weighted[..., :, None] * gain[..., None, :]
            found.append((error, variance, gain))
        yield _Step(mean, covariance, found)


def _dot(values: Floats, row: Floats) -> Floats:
    """``values @ row`` over the last axis."""
    total = np.zeros(values.shape[:-1])
    for j in np.flatnonzero(row):
        total = total + values[..., j] * row[j]
    return total


def _apply(matrix: Floats, vector: Floats) -> Floats:
    total = matrix[..., 0] * vector[..., :1]
    for k in range(1, vector.shape[-1]):
        total = total + matrix[..., k] * vector[..., k : k + 1]
    return total


def _product(a: Floats, b: Floats) -> Floats:
    total = a[..., :1] * b[..., :1, :]
    for k in range(1, b.shape[-2]):
        total = total + a[..., k : k + 1] * b[..., k : k + 1, :]
    return total
