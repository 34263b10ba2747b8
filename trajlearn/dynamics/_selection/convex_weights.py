"""Convex combinations of forecasts, found from their errors on held-out episodes."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cauchy_weights", "simplex_minimum"]

Floats = NDArray[np.float64]

_ROUNDS = 20
# of itself, added to the diagonal: members that hardly differ share the weight
_RIDGE = 1e-6


def simplex_minimum(grams: Floats) -> Floats:
    """Weights w >= 0 of sum 1 with the least w' G w, for each matrix G.

    The solution puts its weight on some subset, on which it is proportional to the solution of
    G w = 1. With few members all subsets are tried.

    Parameters
    ----------
    grams : ndarray of shape (..., k, k)
        Positive definite.

    Returns
    -------
    ndarray of shape (..., k)
    """
    k = grams.shape[-1]
    best = np.full(grams.shape[:-2], np.inf)
    weights = np.zeros(grams.shape[:-1])
    for size in range(1, k + 1):
        for chosen in combinations(range(k), size):
            some = list(chosen)
            block = grams[..., some, :][..., some]
            found = np.linalg.solve(block, np.ones((*block.shape[:-1], 1)))[..., 0]
            total = found.sum(axis=-1)
            value = np.where((found >= 0).all(axis=-1) & (total > 0), 1 / total, np.inf)
            better = value < best
            best = np.where(better, value, best)
            full = np.zeros(grams.shape[:-1])
            full[..., some] = found / total[..., None]
            weights = np.where(better[..., None], full, weights)
    return weights


def cauchy_weights(residuals: Floats, typical: Floats, kernel: Floats) -> tuple[Floats, Floats]:
    """Convex weights by horizon of least Cauchy loss, by iterated reweighting.

    The loss is that of the choice of a member, sum_i log(1 + e_i / m), with e_i the squared error
    of the weighted forecast of episode i: in each round an episode counts 1 / (1 + e_i / m). No
    round makes the loss greater, so that from the best single member on it only falls.

    Parameters
    ----------
    residuals : ndarray of shape (k, n, H, d)
        Of few members, in training ranges; NaN where there is nothing to compare.
    typical : ndarray of shape (n, K)
        m of each episode, at each knot.
    kernel : ndarray of shape (K, H)
        Weights of the steps about each knot.

    Returns
    -------
    weights : ndarray of shape (K, k)
    errors : ndarray of shape (n, K)
        Squared errors of the weighted forecasts, about each knot.
    """
    k, _, _, d = residuals.shape
    known = np.asarray(~np.isnan(residuals).any(axis=(0, 3)))
    clean = np.where(known[..., None], residuals, 0.0)
    # (n, H, k, k), then about each knot (n, K, k, k)
    products = np.einsum("knhd,lnhd->nhkl", clean, clean) / d
    mass = np.maximum(known @ kernel.T, 1e-300)
    about = np.einsum("nhkl,Kh->nKkl", products, kernel) / mass[..., None, None]
    reached = (known @ kernel.T) > 0
    alone = np.log1p(np.einsum("nKkk->knK", about) / typical)
    alone = np.where(reached, alone, 0.0).sum(axis=1)
    weights = np.eye(k)[alone.argmin(axis=0)]
    for _ in range(_ROUNDS):
        error = np.einsum("Kk,nKkl,Kl->nK", weights, about, weights)
        trust = np.where(reached, 1 / (1 + error / typical), 0.0)
        grams = np.einsum("nK,nKkl->Kkl", trust, about)
        own = np.einsum("Kkk->Kk", grams)
        grams += np.maximum(_RIDGE * own, 1e-300)[..., None] * np.eye(k)
        weights = simplex_minimum(grams)
    return weights, np.einsum("Kk,nKkl,Kl->nK", weights, about, weights)
