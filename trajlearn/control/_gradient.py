"""Gradient ascent on the return that a trajectory model predicts: it is differentiable in theta."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.stats.qmc import Sobol

from trajlearn.control._climb import Climb
from trajlearn.control._futures import Situation
from trajlearn.control._optimizers import Found, checked_bounds, checked_start
from trajlearn.control._returns import Returns
from trajlearn.dynamics._differentiable import differentiable
from trajlearn.dynamics._forecaster import DIVERGENCE_RANGES
from trajlearn.dynamics._members import unwrapped
from trajlearn.regressors._threads import threads_for

__all__ = ["ReturnGradient", "ascend", "value_and_gradient"]

Floats = NDArray[np.float64]

# states predicted at once, of all members: autograd keeps some kB of each
_CHUNK_STATES = 2**15
# step of a central difference of the reward, in training ranges of the states
_STEP = 1e-5
# fewer steps get nowhere: then rather fewer restarts
_LEAST_STEPS = 10
# points that climb to the end
_FINALISTS = 4


class Climbable(Protocol):
    """A predicted return that may have a derivative, such as a `PredictedReturn`."""

    def gradient(self) -> "ReturnGradient":
        """Prepare the derivative, or raise ValueError and say why there is none."""
        ...


def value_and_gradient(objective: Climbable, params: ArrayLike) -> tuple[Floats, Floats]:
    r"""Predicted return of candidates, and its derivative in theta.

    .. math:: \nabla_\theta R = \frac1{n_0} \sum_{i, t} w_t
        \Big(\frac{\partial \hat s_t}{\partial \theta}\Big)^{\!\top} \nabla r(\hat s_t),

    with the derivative of the states by automatic differentiation and that of the reward, any
    function of numpy arrays, by central differences. Which steps a trajectory earns at (it may
    end, or diverge) is held constant.

    Parameters
    ----------
    objective : PredictedReturn
        Of a trajectory model, see `trajlearn.dynamics.differentiable`, with ``risk="mean"``; its
        constraint is not looked at.
    params : array-like of shape (m, p)

    Returns
    -------
    values : ndarray of shape (m,)
        -inf where a trajectory diverges and no terminal reward says what that is worth.
    gradients : ndarray of shape (m, p)
        Zero where the value is not finite.

    Raises
    ------
    ValueError
        If the objective has no derivative; it says why.
    """
    gradient = objective.gradient()
    theta = np.asarray(params, dtype=np.float64)
    if theta.ndim != 2 or theta.shape[1] != gradient.n_params or not np.isfinite(theta).all():
        raise ValueError(
            f"params of shape {theta.shape} must be finite and of shape (m, {gradient.n_params})."
        )
    return gradient(theta)


class ReturnGradient:
    """`value_and_gradient` of one objective, prepared once by `PredictedReturn.gradient`.

    Parameters
    ----------
    model : estimator
        One of `trajlearn.dynamics.differentiable`.
    situation : Situation
    returns : Returns

    Attributes
    ----------
    n_params : int
        p.
    """

    def __init__(self, model: Any, situation: Situation, returns: Returns) -> None:
        self._situation, self._returns = situation, returns
        self._function = differentiable(model, context=situation.context)
        self.n_params = self._function.n_params
        low, high = unwrapped(model).state_range_
        self._middle, self._range = (low + high) / 2, np.where(high > low, high - low, 1.0)

    def __call__(self, params: Floats) -> tuple[Floats, Floats]:
        """Values (m,) and gradients (m, p) of candidates (m, p)."""
        states = len(self._situation.initial_states) * len(self._situation.horizons)
        size = max(_CHUNK_STATES // (states * self._function.n_members), 1)
        # sums on several threads may differ in bits
        with threads_for(0.0):
            parts = [self._chunk(params[at : at + size]) for at in range(0, len(params), size)]
        values, gradients = (np.concatenate(column) for column in zip(*parts))
        return values, gradients

    def _chunk(self, params: Floats) -> tuple[Floats, Floats]:
        situation = self._situation
        shape = len(params), len(situation.initial_states)
        theta = torch.tensor(params, device=self._function.device, requires_grad=True)
        means = self._function(
            situation.starts(len(params)),
            theta.repeat_interleave(shape[1], dim=0),
            situation.horizons,
        ).mean(dim=0)
        returns, slopes = self._slopes(means.detach().cpu().numpy(), params)
        values = returns.reshape(shape).mean(axis=1)
        means.backward(torch.from_numpy(slopes / shape[1]).to(means.device))
        assert theta.grad is not None  # backward has just set it
        gradients = theta.grad.cpu().numpy()
        known = np.isfinite(values)[:, None] & np.isfinite(gradients)
        return values, np.where(known, gradients, 0.0)

    def _slopes(self, states: Floats, params: Floats) -> tuple[Floats, Floats]:
        """Returns (n,) of trajectories (n, k, d_s), and their derivative in the states."""
        with np.errstate(invalid="ignore"):
            near = np.abs(states - self._middle) <= DIVERGENCE_RANGES * self._range
        gone = np.logical_or.accumulate(~near.all(axis=-1), axis=-1)
        states, count, _ = self._returns.lived(states, gone if gone.any() else None)
        returns = self._returns.of(states, count, params)
        weights = self._returns.quadrature.earned(count)
        slopes = np.empty_like(states)
        reward, signals = self._returns.reward, self._returns.signals.of(states, params)
        with np.errstate(all="ignore"):
            for j, step in enumerate(_STEP * self._range):
                ends = []
                for sign in (1, -1):
                    shifted = states.copy()
                    shifted[..., j] += sign * step
                    ends.append(np.asarray(reward(shifted, **signals), dtype=np.float64))
                slopes[..., j] = weights * (ends[0] - ends[1]) / (2 * step)
        return returns, np.where(np.isfinite(slopes) & (weights > 0)[..., None], slopes, 0.0)


def ascend(
    objective: Climbable,
    bounds: ArrayLike,
    *,
    n_evaluations: int,
    rng: np.random.Generator,
    start: ArrayLike | None = None,
    n_restarts: int = 32,
    on_batch: Callable[[Floats, Floats], object] | None = None,
) -> Found:
    """Follow the gradient of the predicted return from many points at once.

    Spectral projected gradients [1]_ in the unit cube, from the start points and the points of a
    scrambled Sobol sequence. As the budget is used, the worse half of the points is given up,
    again and again, down to four.

    Parameters
    ----------
    objective : PredictedReturn
        As in `value_and_gradient`.
    bounds : array-like of shape (p, 2)
        Lower bound first; no candidate lies beyond.
    n_evaluations : int
        Candidates that are evaluated at most; a value and its gradient count as one. Fewer are
        where all points have come to rest.
    rng : Generator
    start : array-like of shape (p,) or (k, p), optional
        Among the first that are evaluated, so that what is found is never worse.
    n_restarts : int, default=32
        Points to begin with, the start points included: fewer where the budget would give each
        less than 10 steps.
    on_batch : callable, optional
        Called with the candidates and the values of each batch.

    Returns
    -------
    Found
        The best of all candidates.

    Raises
    ------
    ValueError
        If the objective has no derivative, or bounds or start points are wrong.

    References
    ----------
    .. [1] E. G. Birgin, J. M. Martinez and M. Raydan, "Nonmonotone Spectral Projected Gradient
       Methods on Convex Sets", SIAM Journal on Optimization 10 (2000).
    """
    box = checked_bounds(bounds)
    if n_evaluations < 1 or n_restarts < 1:
        raise ValueError(
            f"n_evaluations = {n_evaluations} and n_restarts = {n_restarts} must be at least 1."
        )
    gradient = objective.gradient()
    if len(box) != gradient.n_params:
        raise ValueError(
            f"bounds has {len(box)} rows, but the model was fitted with {gradient.n_params} params."
        )
    low, width = box[:, 0], box[:, 1] - box[:, 0]
    climb = Climb(_first_points(box, n_evaluations, rng, start, n_restarts))
    # every halving when the same share of the budget is used
    share = n_evaluations / (1 + max(int(np.log2(len(climb.next) / _FINALISTS)), 0))
    best, next_cut = Found(box.mean(axis=1), -np.inf, 0), share
    while len(climb.next) and (left := n_evaluations - best.n_evaluations):
        climb.keep(np.arange(min(left, len(climb.next))))
        candidates = np.clip(low + width * climb.next, box[:, 0], box[:, 1])
        values, slopes = gradient(candidates)
        values = np.where(np.isfinite(values), values, -np.inf)
        top, done = int(values.argmax()), best.n_evaluations + len(values)
        better = values[top] > best.value or not best.n_evaluations
        best = Found(
            candidates[top].copy() if better else best.params,
            float(values[top]) if better else best.value,
            done,
        )
        if on_batch is not None:
            on_batch(candidates, values)
        climb.tell(values, slopes * width)
        if done >= next_cut and len(climb.next) >= 2 * _FINALISTS:
            climb.keep(np.argsort(-climb.values, kind="stable")[: len(climb.next) // 2])
            next_cut += share
        climb.keep(np.flatnonzero(climb.moving()))
    return best


def _first_points(
    box: Floats,
    n_evaluations: int,
    rng: np.random.Generator,
    start: ArrayLike | None,
    n_restarts: int,
) -> Floats:
    """Points of the unit cube to climb from: the start points, then Sobol points."""
    given = np.empty((0, len(box)))
    if start is not None:
        given = (checked_start(start, box) - box[:, 0]) / (box[:, 1] - box[:, 0])
    n = max(min(n_restarts, n_evaluations // _LEAST_STEPS), len(given), 1)
    fresh = max(n - len(given), 0)
    # a power of two, as the sequence is made for
    drawn = Sobol(len(box), rng=rng).random_base2(int(np.ceil(np.log2(max(fresh, 1)))))[:fresh]
    return np.concatenate([given, drawn])[:n_evaluations]
