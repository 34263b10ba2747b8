"""Small matrices side by side, each with the same bits whatever stands beside it.

Every number comes from sums, products and quotients of single elements, term after term, never
from a matrix product of a library, whose bits may depend on the other matrices.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "applied",
    "finite_in",
    "nearest_semidefinite",
    "product",
    "root_of",
    "transposed",
    "whitened",
]

Floats = NDArray[np.float64]

# a variance that is known from the others but for this share of it is known
_LEAST = 1e-12


def finite_in(matrix: Floats) -> NDArray[np.bool_]:
    """Which of the matrices (..., i, j) are finite."""
    finite: NDArray[np.bool_] = np.all(np.isfinite(matrix), axis=(-2, -1))
    return finite


def transposed(matrix: Floats) -> Floats:
    """Matrices (..., i, j) as (..., j, i)."""
    return np.swapaxes(matrix, -1, -2)


def product(left: Floats, right: Floats) -> Floats:
    """Matrices (..., i, k) times (..., k, j)."""
    total = left[..., :, :1] * right[..., :1, :]
    for k in range(1, left.shape[-1]):
        total += left[..., :, k, None] * right[..., None, k, :]
    return total


def applied(matrix: Floats, vector: Floats) -> Floats:
    """Matrices (..., i, k) times vectors (..., k)."""
    total = matrix[..., :, 0] * vector[..., :1]
    for k in range(1, matrix.shape[-1]):
        total += matrix[..., :, k] * vector[..., k, None]
    return total


def root_of(covariance: Floats) -> Floats:
    """Lower Cholesky factors of positive semi-definite matrices (..., d, d).

    A direction without variance of its own has a column of zeros.
    """
    root = np.zeros_like(covariance)
    for j in range(covariance.shape[-1]):
        column = covariance[..., j:, j].copy()
        for k in range(j):
            column -= root[..., j:, k] * root[..., j, k, None]
        pivot = column[..., 0]
        spread = pivot > _LEAST * covariance[..., j, j]
        divisor = np.sqrt(np.where(spread, pivot, 1.0))
        root[..., j:, j] = np.where(spread[..., None], column / divisor[..., None], 0.0)
    return root


def whitened(root: Floats, vector: Floats) -> Floats:
    """Solution u of ``root @ u = vector`` for factors of `root_of`, zero where they are."""
    shape = np.broadcast_shapes(root.shape[:-1], vector.shape)
    solved = np.zeros(shape)
    for j in range(shape[-1]):
        rest = np.broadcast_to(vector[..., j], shape[:-1]).copy()
        for k in range(j):
            rest -= root[..., j, k] * solved[..., k]
        pivot = root[..., j, j]
        spread = pivot > 0
        solved[..., j] = np.where(spread, rest / np.where(spread, pivot, 1.0), 0.0)
    return solved


def nearest_semidefinite(matrix: Floats) -> Floats:
    """Symmetric matrices (..., d, d) without their negative eigenvalues; non-finite ones stay."""
    finite = finite_in(matrix)
    safe = np.where(finite[..., None, None], (matrix + transposed(matrix)) / 2, 0.0)
    values, vectors = np.linalg.eigh(safe)
    half = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    mended = np.where((values[..., 0] < 0)[..., None, None], product(half, transposed(half)), safe)
    return np.where(finite[..., None, None], mended, matrix)
