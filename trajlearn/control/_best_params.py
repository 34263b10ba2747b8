"""The parameters of the greatest predicted return, among those that keep a constraint."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._optimizers import maximise
from trajlearn.control._safe_set import best_to_worst, ranked
from trajlearn.control.objective import PredictedReturn

__all__ = ["COPIES", "Goal", "best_params"]

Floats = NDArray[np.float64]

# candidates that keep the constraint in some samples and are judged by others, this many times more
_CONFIRMED, COPIES = 64, 4


@dataclass(frozen=True)
class Goal:
    """What is maximised, and who judges it.

    Attributes
    ----------
    objective : callable
        ``objective(model, seed, constrained=True, copies=1)``, a `PredictedReturn`.
    model : estimator
        Judges the constraint.
    judge : estimator
        Judges the return: `model` itself, or a member of it.
    max_violation : float or None
        None where there is no constraint.
    """

    objective: Callable[..., PredictedReturn]
    model: Any
    judge: Any
    max_violation: float | None

    def value(self, seed: int) -> Callable[[Floats], Floats]:
        """Values (m,) of candidates (m, p), without the constraint."""
        objective = self.objective(self.judge, seed, constrained=False)
        return lambda params: objective(params).value

    def rank(self, seed: int, limit: float, copies: int = 1) -> Callable[[Floats], Floats]:
        """Values of candidates, those that violate the constraint too often below all others."""
        guard = self.objective(self.model, seed, copies=copies)
        own = None if self.judge is self.model else self.value(seed)

        def rank(params: Floats) -> Floats:
            found = guard(params)
            wanted = found.value if own is None else own(params)
            return ranked(wanted, found.violation, limit)

        return rank

    def keeps(self, seed: int, params: Floats) -> bool:
        """Whether params (p,) keep the constraint, if there is one."""
        if self.max_violation is None:
            return True
        violation = self.objective(self.model, seed, copies=COPIES)(params[None]).violation
        return violation is None or bool(violation[0] <= self.max_violation)


def best_params(
    goal: Goal,
    bounds: Floats,
    *,
    seed: int,
    optimizer: str,
    n_evaluations: int,
    rng: np.random.Generator,
    start: Floats | None,
) -> tuple[Floats, int]:
    """The best params (p,) that an optimiser finds, and the seed to assess them with.

    Parameters
    ----------
    goal : Goal
    bounds : ndarray of shape (p, 2)
    seed : int
        Of the samples by which candidates are judged.
    optimizer : str
        A method of `maximise`, or "gradient".
    n_evaluations : int
    rng : Generator
    start : ndarray of shape (k, p) or None
        Evaluated first.
    """
    settings: dict[str, Any] = {"n_evaluations": n_evaluations, "rng": rng}
    limit, method = goal.max_violation, optimizer
    if method == "gradient":
        from trajlearn.control._gradient import ascend

        objective = goal.objective(goal.judge, seed, constrained=False)
        found = ascend(objective, bounds, start=start, **settings).params
        if goal.keeps(seed, found):
            return found, seed
        # a share of trajectories has no gradient: go on without
        method = "cma"
        start = found[None] if start is None else np.vstack([found, start])
    if limit is None:
        best = maximise(goal.value(seed), bounds, method=method, start=start, **settings)
        return best.params, seed
    tried: list[tuple[Floats, Floats]] = []
    maximise(
        goal.rank(seed, limit),
        bounds,
        method=method,
        start=start,
        on_batch=lambda *batch: tried.append(batch),
        **settings,
    )
    # judged again, by other and more samples
    chosen, before = best_to_worst(tried, _CONFIRMED)
    seed = int(rng.integers(2**31))
    again = goal.rank(seed, limit, COPIES)(chosen)
    return chosen[int(np.argmax(np.minimum(before, again)))], seed
