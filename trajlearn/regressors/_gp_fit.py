"""Fitting one output of a Gaussian process: several starts, then L-BFGS on all rows."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from sklearn.cluster import KMeans

from trajlearn.regressors._gp_models import (
    Floats,
    LogNormalPrior,
    Objective,
    build_kernel,
    exact_objective,
    sparse_objective,
)

# Starts compete on this many rows: enough to find the right basin, and cheap (n^3).
_START_ROWS = 200
# relative; a thousandth of a nat of marginal likelihood changes no prediction
_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Draws:
    """All that is random in a fit, drawn once, so that outputs do not depend on each other."""

    order: NDArray[np.intp]
    normals: Floats
    kmeans_seed: int

    @classmethod
    def make(cls, rng: np.random.RandomState, shape: tuple[int, ...], n_restarts: int) -> "Draws":
        """Draw an order of the rows, the random starts and a seed for k-means."""
        n, n_features = shape
        return cls(
            rng.permutation(n),
            rng.standard_normal((n_restarts, n_features + 2)),
            int(rng.randint(2**31)),
        )


@dataclass(frozen=True)
class Search:
    """The estimator's parameters that matter here."""

    kernel: str
    max_iter: int
    max_fit_rows: int
    n_inducing: int


class Minimum(NamedTuple):
    """Where L-BFGS ended: theta (and inducing points), its value and how it came there."""

    point: Floats
    value: float
    n_iter: int
    converged: bool


def minimise(objective: Objective, prior: LogNormalPrior, start: Floats, max_iter: int) -> Minimum:
    """L-BFGS-B on the objective plus the prior's penalty on theta, the head of the flat vector."""
    n_theta = len(prior.mean)

    def penalised(flat: Floats) -> tuple[float, Floats]:
        value, grad = objective(flat)
        penalty, penalty_grad = prior.penalty(flat[:n_theta])
        grad[:n_theta] += penalty_grad
        return value + penalty, grad

    n_free = len(start) - n_theta
    result = minimize(
        penalised,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[*zip(prior.lower, prior.upper), *([(None, None)] * n_free)],
        options={"maxiter": max_iter, "ftol": _TOLERANCE},
    )
    return Minimum(result.x, float(result.fun), int(result.nit), result.status != 1)


def fit_exact(inputs: Floats, targets: Floats, search: Search, draws: Draws) -> Minimum:
    """Theta of an exact GP (maximum a posteriori)."""
    best = _best_start(inputs, targets, search, draws)
    if len(inputs) <= _START_ROWS:
        return best
    objective = exact_objective(build_kernel(search.kernel, inputs.shape[1]), inputs, targets)
    prior = LogNormalPrior.for_inputs(inputs.shape[1])
    return minimise(objective, prior, best.point, search.max_iter)


def fit_sparse(
    inputs: Floats, targets: Floats, search: Search, draws: Draws
) -> tuple[Minimum, Floats]:
    """Theta and inducing points (m, d) of a sparse GP.

    The points start at k-means centres in inputs divided by the length scales of an exact GP
    on few rows, so that inputs which do not matter do not spread them; L-BFGS moves them.
    """
    theta = _best_start(inputs, targets, search, draws).point
    rows = draws.order[: search.max_fit_rows]
    inputs, targets = inputs[rows], targets[rows]
    n_features = inputs.shape[1]
    length_scales = np.exp(theta[:n_features])
    m = min(search.n_inducing, len(np.unique(inputs, axis=0)))
    kmeans = KMeans(m, n_init=1, max_iter=20, random_state=draws.kmeans_seed)
    points = kmeans.fit(inputs / length_scales).cluster_centers_ * length_scales
    objective = sparse_objective(build_kernel(search.kernel, n_features), inputs, targets, m)
    prior = LogNormalPrior.for_inputs(n_features)
    start = np.concatenate([theta, points.ravel()])
    found = minimise(objective, prior, start, search.max_iter)
    theta, points = np.split(found.point, [n_features + 2])
    return found._replace(point=theta), points.reshape(m, n_features)


def _best_start(inputs: Floats, targets: Floats, search: Search, draws: Draws) -> Minimum:
    """The best of all starts, on all rows or on as many as starts compete on."""
    if len(inputs) > _START_ROWS:
        rows = draws.order[:_START_ROWS]
        inputs, targets = inputs[rows], targets[rows]
    prior = LogNormalPrior.for_inputs(inputs.shape[1])
    objective = exact_objective(build_kernel(search.kernel, inputs.shape[1]), inputs, targets)
    starts = prior.starts(draws.normals)
    found = [minimise(objective, prior, start, search.max_iter) for start in starts]
    return min(found, key=lambda minimum: minimum.value)
