"""Smoothing many episodes at once with a learned step: Rauch, Tung and Striebel, linearised.

The most probable states given all measurements solve a block tridiagonal system, one block a
state. Its factorisation runs forward as a filter does, and its solution backward as the smoother
of Rauch, Tung and Striebel, with the same estimates and covariances. It is faster than their
form, because what does not depend on the recursion is computed for all states together.
Linearised about its own estimate and solved again it is the iterated extended smoother, which is
Gauss-Newton's method.

References
----------
H. E. Rauch, F. Tung and C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems",
AIAA J. 3 (1965) 1445-1450.
B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994)
626-636.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Posterior", "Problem", "smooth_states"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Problem:
    """n episodes side by side, padded to L states of d numbers, the first m of which are measured.

    About given states a step is ``after + slopes @ (x - states)``, followed by process noise.
    """

    measured: Floats
    """(L, n, m)."""
    known: NDArray[np.bool_]
    """False in the padding behind shorter episodes (L, n)."""
    states: Floats
    """Where the step is linearised (L, n, d)."""
    after: Floats
    """(L - 1, n, d)."""
    slopes: Floats
    """(L - 1, n, d, d)."""

    def few(self, chosen: NDArray[np.intp]) -> "Problem":
        """The same of some of the episodes."""
        return Problem(*(values[:, chosen] for values in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian of all states of each episode given its measurements."""

    mean: Floats
    """(L, n, d)."""
    covariance: Floats
    """(L, n, d, d)."""
    missed: Floats
    """Sum of the squared measurement errors, as expected under it (m,)."""
    pushed: Floats
    """Sum of the squared process noise, as expected under it (d,)."""
    n_measured: int
    n_steps: int
    deviance: float
    """-2 log likelihood of the measurements."""


def smooth_states(
    problem: Problem,
    *,
    measurement: Floats,
    process: Floats,
    start_mean: Floats,
    start_covariance: Floats,
) -> Posterior:
    """Smooth all episodes under independent noise in every number.

    Parameters
    ----------
    problem : Problem
    measurement, process : ndarray of shape (m,) and (d,)
        Variances.
    start_mean : ndarray of shape (d,) or (n, d)
    start_covariance : ndarray of shape (d, d) or (n, d, d)
        Of the first state before its measurement.

    Returns
    -------
    Posterior
    """
    known, states = problem.known, problem.states
    (n_states, n, d), m = states.shape, problem.measured.shape[2]
    follows = known[1:, :, None]
    # deviations from the states of the linearisation: of measurements, of the step, of the start
    error = np.where(known[..., None], problem.measured - states[..., :m], 0.0)
    gap = np.where(follows, problem.after - states[1:], 0.0)
    slopes = np.where(follows[..., None], problem.slopes, 0.0)
    off = start_mean - states[0]
    start_covariance = np.broadcast_to(start_covariance, (n, d, d))
    sure = np.linalg.inv(start_covariance)
    sure_off = _applied(sure, off)
    # the precision of all states of an episode: diagonal blocks, and -weighted' beside them
    weighted = slopes / process[:, None]
    back = np.swapaxes(weighted, -1, -2)
    blocks = np.zeros((n_states, n, d, d))
    blocks[:-1] = back @ slopes
    blocks[0] += sure
    at = np.arange(d)
    # a state in the padding stands alone, with a unit block
    blocks[1:, :, at, at] += np.where(follows, 1 / process, 1.0)
    blocks[:, :, at[:m], at[:m]] += known[..., None] / measurement
    right = np.zeros((n_states, n, d))
    right[:-1] = -_applied(back, gap)
    right[1:] += gap / process
    right[..., :m] += error / measurement
    right[0] += sure_off
    moved, covariance, above, log_det = _solved(blocks, weighted, right)

    spread = np.diagonal(covariance, axis1=-2, axis2=-1)
    left = np.where(known[..., None], error - moved[..., :m], 0.0)
    missed = (left**2 + spread[..., :m] * known[..., None]).sum(axis=(0, 1))
    push = moved[1:] - _applied(slopes, moved[:-1]) - gap
    variance = spread[1:] - 2 * np.einsum("tnij,tnji->tni", slopes, above)
    variance += np.einsum("tnij,tnij->tni", slopes @ covariance[:-1], slopes)
    pushed = ((push**2 + np.maximum(variance, 0.0)) * follows).sum(axis=(0, 1))
    count, steps = int(known.sum()), int(follows.sum())
    deviance = (error**2).sum(axis=(0, 1)) @ (1 / measurement)
    deviance += (gap**2).sum(axis=(0, 1)) @ (1 / process)
    deviance += np.sum(off * sure_off) - np.sum(right * moved) + log_det
    deviance += count * np.log(2 * np.pi * measurement).sum() + steps * np.log(process).sum()
    deviance += np.linalg.slogdet(start_covariance)[1].sum()
    return Posterior(states + moved, covariance, missed, pushed, count, steps, float(deviance))


def _solved(blocks: Floats, beside: Floats, right: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Solve a positive definite block tridiagonal system for each of n episodes.

    Parameters
    ----------
    blocks : ndarray of shape (L, n, d, d)
        On the diagonal; overwritten.
    beside : ndarray of shape (L - 1, n, d, d)
        Minus those below it.
    right : ndarray of shape (L, n, d)

    Returns
    -------
    solution : ndarray of shape (L, n, d)
    diagonal, above : ndarray of shape (L, n, d, d) and (L - 1, n, d, d)
        Blocks of the inverse: the covariance of each state, and of it with the next one.
    log_det : float
        Of all systems together.
    """
    solution = right[..., None].copy()
    gains = np.empty_like(beside)
    for t in range(len(beside)):
        blocks[t] = np.linalg.inv(blocks[t])
        gains[t] = beside[t] @ blocks[t]
        blocks[t + 1] -= gains[t] @ np.swapaxes(beside[t], -1, -2)
        solution[t + 1] += gains[t] @ solution[t]
    blocks[-1] = np.linalg.inv(blocks[-1])
    log_det = -float(np.linalg.slogdet(blocks)[1].sum())
    solution = blocks @ solution
    gains = np.swapaxes(gains, -1, -2)
    above = np.empty_like(beside)
    for t in range(len(beside) - 1, -1, -1):
        solution[t] += gains[t] @ solution[t + 1]
        above[t] = gains[t] @ blocks[t + 1]
        blocks[t] += above[t] @ np.swapaxes(gains[t], -1, -2)
    return solution[..., 0], blocks, above, log_det


def _applied(matrix: NDArray[Any], vector: NDArray[Any]) -> Floats:
    product: Floats = (matrix @ vector[..., None])[..., 0]
    return product
