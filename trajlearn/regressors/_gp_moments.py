"""Exact moments of a Gaussian process at an input that is itself Gaussian.

With ``x ~ N(mu, S)`` the mean, the covariance of all outputs and the covariance of input and
outputs are integrals of squared-exponential kernels and known in closed form (Quinonero-Candela
et al. 2003; Girard et al. 2003; Deisenroth and Rasmussen 2011, "PILCO").

Written so that nothing is inverted that may be singular and nothing large cancels: S enters by
``T = (D + S^-1)^-1 = (I + S D)^-1 S`` with the inverse squared length scales D, and a product of
kernels by its excess ``E[k_i k_j] / (E[k_i] E[k_j]) - 1``, which vanishes with S.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from trajlearn.regressors._gp_models import Floats
from trajlearn.regressors._gp_posterior import BLOCK, Explained
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors.gp import GPRegressor

__all__ = ["GaussianMoments", "noise_variance"]

# elements of a matrix of excesses that are held at once: they stay in the processor's cache
_TILE = 131_072

# A kernel expected below exp(-300) of its height adds nothing, and would overflow its excess.
_NOTHING = -300.0

# Standardised inputs (and their standard deviations, 1e5) beyond these are as good as infinite;
# the arithmetic of a roll-out that diverges stays finite.
_FAR, _WIDE = 1e10, 1e10

# negative eigenvalues of a covariance, in shares of the greatest, that are taken for round-off
_ROUND_OFF = 1e-6


def noise_variance(gp: GPRegressor) -> Floats:
    """Variance of an observation about f(x), in squared target units (d,)."""
    check_is_fitted(gp)
    variance: Floats = np.square(gp.noise_std_)
    return variance


class GaussianMoments:
    """Moments of one GP at any number of Gaussian inputs.

    The moments of an input do not depend on the other inputs, to the last bit. Time and memory
    grow with the square of the basis; calls run on one thread.

    Parameters
    ----------
    gp : GPRegressor
        Fitted with ``kernel="rbf"``.

    Raises
    ------
    ValueError
        If the kernel is another: its integrals have no closed form.
    """

    def __init__(self, gp: GPRegressor) -> None:
        check_is_fitted(gp)
        if gp.kernel != "rbf":
            raise ValueError(
                f'kernel = "{gp.kernel}": the moments at a Gaussian input are known in closed form '
                'for kernel="rbf" only. Fit a GPRegressor(kernel="rbf"), or propagate samples.'
            )
        self._gp = gp
        with threads_for(0.0):
            self._outputs = [_output(gp, i) for i in range(len(gp.weights_))]

    def __call__(self, mean: ArrayLike, covariance: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Moments of f(x) at Gaussian inputs x, in the units of the data.

        Parameters
        ----------
        mean : array-like of shape (m, k)
        covariance : array-like of shape (m, k, k)
            Symmetric and positive semi-definite; zero for an input that is known.

        Returns
        -------
        mean : ndarray of shape (m, d)
            Expectation of f(x); d is 1 for a GP fitted to a 1-D y.
        covariance : ndarray of shape (m, d, d)
            Of f(x): what follows from the spread of x and the GP's own uncertainty about f, without
            the noise of an observation (`noise_variance`). Symmetric, positive semi-definite.
        cross : ndarray of shape (m, k, d)
            Covariance of x and f(x).

        Raises
        ------
        ValueError
            If a shape is wrong, a value is not finite, or a covariance is
            not symmetric and positive semi-definite.
        """
        gp = self._gp
        mu, s = _standardised(gp, mean, covariance)
        m, k, d = len(mu), gp.n_features_in_, len(self._outputs)
        means, spread, cross = np.empty((m, d)), np.empty((m, d, d)), np.empty((m, k, d))
        with threads_for(0.0):
            for at in range(0, m, BLOCK):
                here = slice(at, at + BLOCK)
                means[here], spread[here], cross[here] = self._block(mu[here], s[here])
        means = gp.target_mean_ + gp.target_scale_ * means
        spread = _semi_definite(spread) * (gp.target_scale_[:, None] * gp.target_scale_)
        return means, spread, cross * (gp.input_scale_[:, None] * gp.target_scale_)

    def _block(self, mu: Floats, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Moments of a few inputs in standardised units."""
        m, k, d = len(mu), mu.shape[1], len(self._outputs)
        means, spread, cross = np.empty((m, d)), np.empty((m, d, d)), np.empty((m, k, d))
        expected = [_expect(output, mu, s) for output in self._outputs]
        for a, (output, kernel) in enumerate(zip(self._outputs, expected)):
            weighted = output.weights * kernel.values
            means[:, a] = weighted.sum(axis=1)
            slope = (weighted[:, :, None] * kernel.offsets).sum(axis=1)
            cross[:, :, a] = (kernel.t @ slope[:, :, None])[:, :, 0]
            for b in range(a + 1):
                spread[:, a, b] = _covariances(output, kernel, self._outputs[b], expected[b], s)
                spread[:, b, a] = spread[:, a, b]
            spread[:, a, a] += output.signal - output.explained(kernel.values)
        return means, spread, cross


@dataclass(frozen=True)
class _Output:
    """The posterior of one output in standardised units."""

    precision: Floats  # inverse squared length scales (k,)
    signal: float
    basis: Floats  # (n, k)
    weights: Floats  # (n,)
    explained: Explained
    # products of weights minus the inverse covariance of the basis; below the diagonal zero,
    # above it doubled
    products: torch.Tensor


def _output(gp: GPRegressor, i: int) -> _Output:
    h = gp._hyperparameters(i)
    basis = gp.basis_[i if gp.is_sparse_ else 0]
    weights, root = gp.weights_[i], gp.root_[i]
    products = np.outer(weights, weights) - root.T @ root
    upper = torch.tensor(np.triu(products) + np.triu(products, 1))
    precision = h.length_scales**-2.0
    return _Output(precision, h.signal_variance, basis, weights, Explained(root), upper)


class _Expected(NamedTuple):
    """Kernels of one output expected at m Gaussian inputs."""

    values: Floats  # E[k_i] (m, n)
    offsets: Floats  # D (basis - mu), zero where E[k_i] vanishes (m, n, k)
    t: Floats  # (m, k, k)
    log_det: Floats  # of I + S D (m,)


def _shrink(s: Floats, precision: Floats) -> tuple[Floats, Floats, Floats]:
    """T = (I + S D)^-1 S, the Cholesky factor of I + D^1/2 S D^1/2 and its log determinant."""
    half = np.sqrt(precision)
    scaled = half[:, None] * s
    inner = scaled * half + np.eye(len(half))
    factor = np.asarray(np.linalg.cholesky(inner), dtype=np.float64)
    t: Floats = np.linalg.solve(inner, scaled) / half[:, None]
    log_det: Floats = 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return 0.5 * (t + t.transpose(0, 2, 1)), factor, log_det


def _expect(output: _Output, mu: Floats, s: Floats) -> _Expected:
    """Integrals of the kernels of one output over the inputs."""
    t, factor, log_det = _shrink(s, output.precision)
    half = np.sqrt(output.precision)
    offsets = (output.basis - mu[:, None, :]) * half
    whitened = np.linalg.solve(factor, offsets.transpose(0, 2, 1))
    log_values = -0.5 * (np.square(whitened).sum(axis=1) + log_det[:, None])
    offsets *= half
    offsets[log_values < _NOTHING] = 0.0
    return _Expected(output.signal * np.exp(log_values), offsets, t, log_det)


def _covariances(left: _Output, a: _Expected, right: _Output, b: _Expected, s: Floats) -> Floats:
    """Covariance, over the inputs, of two posterior means (m,).

    Of an output with itself also minus what the spread adds to the expected explained variance:
    both are sums over the same excesses.
    """
    t, _, log_det = _shrink(s, left.precision + right.precision)
    pushed = a.offsets @ t
    rows = 0.5 * (a.offsets * (pushed - a.offsets @ a.t)).sum(axis=2)
    rows += 0.5 * (a.log_det + b.log_det - log_det)[:, None]
    columns = 0.5 * (b.offsets * (b.offsets @ (t - b.t))).sum(axis=2)
    same = left is right
    if same:
        u, v = a.values, b.values
    else:
        u, v = left.weights * a.values, right.weights * b.values
    excess = _Excess(rows.shape[1], columns.shape[1], t.shape[1], left.products if same else None)
    return np.array([excess.sum(*args) for args in zip(pushed, rows, b.offsets, columns, u, v)])


class _Excess:
    """``sum_ij u_i v_j exp(p_i . z_j + r_i + c_j) - u_i v_j``, optionally weighted, one input.

    All inputs go through the same aligned memory, so that each gets the same bits in any batch.
    """

    def __init__(self, n: int, m: int, k: int, products: torch.Tensor | None) -> None:
        width = -(-(k + 2) // 8) * 8
        self._k, self._products = k, products
        self._left = torch.zeros((n, width), dtype=torch.float64)
        self._right = torch.zeros((m, width), dtype=torch.float64)
        self._left[:, k + 1] = self._right[:, k] = 1.0
        self._u, self._v = self._left.new_empty(n), self._left.new_empty(m)
        self._step = max(1, min(n, _TILE // m))
        self._out = self._left.new_empty(self._step * m)

    def sum(self, p: Floats, r: Floats, z: Floats, c: Floats, u: Floats, v: Floats) -> float:
        """Take p (n, k), r (n,), z (m, k), c (m,), u (n,) and v (m,)."""
        k, left, right = self._k, self._left.numpy(), self._right.numpy()
        left[:, :k], left[:, k] = p, r
        right[:, :k], right[:, k + 1] = z, c
        self._u.numpy()[:], self._v.numpy()[:] = u, v
        total = 0.0
        for at in range(0, len(u), self._step):
            rows = slice(at, at + self._step)
            # the products hold a symmetric matrix in its upper half
            first = 0 if self._products is None else at
            shape = len(self._left[rows]), len(v) - first
            out = self._out[: shape[0] * shape[1]].view(shape)
            torch.mm(self._left[rows], self._right[first:].T, out=out)
            out.expm1_()
            if self._products is not None:
                out.mul_(self._products[rows, first:])
            total += float(torch.dot(self._u[rows], torch.mv(out, self._v[first:])))
        return total


def _standardised(gp: GPRegressor, mean: ArrayLike, covariance: ArrayLike) -> tuple[Floats, Floats]:
    """Checked inputs in the GP's inner units."""
    mu, s = np.asarray(mean, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    k = gp.n_features_in_
    if mu.ndim != 2 or mu.shape[1] != k or s.shape != (len(mu), k, k):
        raise ValueError(
            f"mean has shape {mu.shape}, covariance {s.shape}: the GP has {k} inputs; give "
            f"(m, {k}) and (m, {k}, {k})."
        )
    for name, values in (("mean", mu), ("covariance", s)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has NaN or infinite values; leave those inputs out.")
    with np.errstate(over="ignore"):
        mu = np.clip((mu - gp.input_offset_) / gp.input_scale_, -_FAR, _FAR)
        s = np.clip(s / gp.input_scale_[:, None] / gp.input_scale_, -1e300, 1e300)
    flipped = s.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(0.5 * s + 0.5 * flipped)
    greatest = np.abs(values).max(axis=1, initial=0.0)
    skew = np.abs(0.5 * s - 0.5 * flipped).max(axis=(1, 2), initial=0.0)
    bad = (values < -_ROUND_OFF * greatest[:, None]).any(axis=1) | (skew > _ROUND_OFF * greatest)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise ValueError(f"covariance {i} is not symmetric and positive semi-definite.")
    s = 0.5 * s + 0.5 * flipped
    mend = (values[:, 0] < -_ROUND_OFF) | (values[:, -1] > _WIDE)
    s[mend] = _compose(np.clip(values[mend], 0.0, _WIDE), vectors[mend])
    return mu, s


def _semi_definite(covariance: Floats) -> Floats:
    """`covariance` (m, d, d) without the negative eigenvalues that round-off leaves."""
    values, vectors = np.linalg.eigh(covariance)
    mend = values[:, 0] < 0.0
    covariance[mend] = _compose(np.maximum(values[mend], 0.0), vectors[mend])
    return covariance


def _compose(values: Floats, vectors: Floats) -> Floats:
    factor = vectors * np.sqrt(values)[:, None, :]
    product: Floats = factor @ factor.transpose(0, 2, 1)
    return product
