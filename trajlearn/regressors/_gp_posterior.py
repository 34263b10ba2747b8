"""The posterior of a Gaussian process in closed form: plain arrays, one output at a time.

Exact and sparse GPs end in the same three arrays: a `basis` of m inputs, `weights` (m,) and a
`root` (m, m), with ``mean(x) = k(x) . weights`` and ``variance(x) = s^2 - |root k(x)|^2``,
where ``k(x)`` is the covariance of f(x) with f at the basis.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import cho_solve, eigh, solve_triangular
from scipy.linalg.lapack import dtrtri
from scipy.spatial.distance import cdist

from trajlearn.regressors._gp_models import JITTER, Floats, Hyperparameters, cholesky
from trajlearn.regressors._threads import threads_for

# rows evaluated at once
BLOCK = 48

_SUM_ROWS = 4096
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Posterior:
    """Weights (m,), root (m, m) and the log marginal likelihood (sparse: its lower bound)."""

    weights: Floats
    root: Floats
    log_likelihood: float


def covariance(kernel: str, left: Floats, right: Floats, h: Hyperparameters) -> Floats:
    """Covariances (len(left), len(right)), each from its own pair of rows only."""
    with np.errstate(over="ignore"):
        scaled = left / h.length_scales
    squared = cdist(scaled, right / h.length_scales, "sqeuclidean")
    # far away every kernel is 0; without the limit Matern's would be infinity times 0
    np.minimum(squared, 1e10, out=squared)
    if kernel == "rbf":
        return h.signal_variance * np.exp(-0.5 * squared)
    r = np.sqrt(squared)
    if kernel == "matern12":
        return h.signal_variance * np.exp(-r)
    if kernel == "matern32":
        r *= np.sqrt(3.0)
        return h.signal_variance * (1.0 + r) * np.exp(-r)
    r *= np.sqrt(5.0)
    return h.signal_variance * (1.0 + r + r * r / 3.0) * np.exp(-r)


def exact_posterior(kernel: str, inputs: Floats, targets: Floats, h: Hyperparameters) -> Posterior:
    """Rasmussen and Williams (2006), algorithm 2.1; the root is the inverse Cholesky factor."""
    noisy = covariance(kernel, inputs, inputs, h)
    noisy[np.diag_indices_from(noisy)] += h.noise_variance
    factor = _cholesky(noisy)
    weights = cho_solve((factor, True), targets)
    value = -0.5 * targets @ weights - np.log(np.diag(factor)).sum()
    return Posterior(weights, _inverse(factor), float(value - 0.5 * len(targets) * _LOG_2PI))


def sparse_posterior(
    kernel: str, points: Floats, inputs: Floats, targets: Floats, h: Hyperparameters
) -> Posterior:
    """Titsias (2009): the best Gaussian over the values at the points, given all rows.

    With ``L L' = K_uu`` and ``I + L^-1 K_uf K_fu L^-T / noise = U diag(e) U'`` the variance is
    ``s^2 - k' L^-T U diag(1 - 1/e) U' L^-1 k``.
    """
    m, n = len(points), len(targets)
    prior = covariance(kernel, points, points, h)
    prior[np.diag_indices(m)] += JITTER * h.signal_variance
    factor = _cholesky(prior)
    gram, projected = np.zeros((m, m)), np.zeros(m)
    for at in range(0, n, _SUM_ROWS):
        rows = slice(at, at + _SUM_ROWS)
        cross = covariance(kernel, points, inputs[rows], h)
        whitened = solve_triangular(factor, cross, lower=True)
        gram += whitened @ whitened.T
        projected += whitened @ targets[rows]
    noise = h.noise_variance
    values, vectors = eigh(gram / noise + np.eye(m))
    values = np.maximum(values, 1.0)
    rotated = vectors.T @ projected / noise
    weights = solve_triangular(factor, vectors @ (rotated / values), lower=True, trans=1)
    root = np.sqrt(1.0 - 1.0 / values)[:, None] * (vectors.T @ _inverse(factor))
    bound = -0.5 * (
        n * (_LOG_2PI + np.log(noise))
        + np.log(values).sum()
        + targets @ targets / noise
        - (rotated**2 / values).sum()
        + (n * h.signal_variance - np.trace(gram)) / noise
    )
    return Posterior(weights, root, float(bound))


def predict_rows(
    kernel: str,
    rows: Floats,
    basis: Floats,
    h: Hyperparameters,
    weights: Floats,
    root: Floats | None,
) -> tuple[Floats, Floats | None]:
    """Mean (n,) and, given a root, variance of f (n,) at standardised rows.

    A row gets the same bits alone, in a batch and in any order: each mean is a sum of its own,
    and the variances come from matrix products of one shape on one thread.
    """
    mean = np.empty(len(rows))
    variance = None if root is None else np.empty(len(rows))
    explained = None if root is None else Explained(root)
    with threads_for(0.0):
        for at in range(0, len(rows), BLOCK):
            here = slice(at, at + BLOCK)
            cross = covariance(kernel, rows[here], basis, h)
            mean[here] = (cross * weights).sum(axis=1)
            if explained is not None and variance is not None:
                variance[here] = h.signal_variance - explained(cross)
    return mean, None if variance is None else np.maximum(variance, 0.0)


class Explained:
    """``|root k|^2`` for the rows k of a block.

    The bits of a matrix product may depend on where in memory its rows lie and on their place
    in a tile. So the factors lie in fresh memory, each row starts at a multiple of 64 bytes,
    and there are always `BLOCK` rows, a multiple of all usual tiles.
    """

    def __init__(self, root: Floats) -> None:
        m = len(root)
        width = -(-m // 8) * 8
        self._root = torch.zeros((width, width), dtype=torch.float64)
        self._root.numpy()[:m, :m] = root
        self._rows = torch.zeros((BLOCK, width), dtype=torch.float64)
        self._out = torch.empty_like(self._rows)

    def __call__(self, cross: Floats) -> Floats:
        n, m = cross.shape
        self._rows.numpy()[:n, :m] = cross
        torch.mm(self._rows, self._root.T, out=self._out)
        explained: Floats = np.square(self._out.numpy()[:n]).sum(axis=1)
        return explained


def _cholesky(matrix: Floats) -> Floats:
    factor: Floats = cholesky(torch.tensor(matrix)).numpy()
    return factor


def _inverse(factor: Floats) -> Floats:
    """Inverse of a lower triangular matrix."""
    inverse, _ = dtrtri(factor, lower=1)
    return np.tril(inverse)
