"""Whether an objective makes sense, and whether its model can answer it."""

from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn.control._futures import predicts_rewards
from trajlearn.dynamics._members import unwrapped

__all__ = [
    "check_answerable",
    "check_width",
    "checked_candidates",
    "checked_starts",
    "one_of",
    "time_step",
    "whole",
]

Floats = NDArray[np.float64]


def whole(value: Any, name: str) -> int:
    """A whole number, at least 1."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} = {value!r} must be a whole number, at least 1.")
    return int(value)


def one_of(allowed: tuple[str, ...], value: str, name: str) -> str:
    """One of the allowed words."""
    if value not in allowed:
        raise ValueError(f"{name} = {value!r}; choose one of {list(allowed)}.")
    return value


def time_step(dt: float | None, model: Any) -> float:
    """Time of a step, as given or as the model knows it.

    Raises
    ------
    ValueError
        If nobody says, or it is not a time.
    """
    if dt is None:
        steps = (getattr(part, "dt_", None) for part in (model, unwrapped(model)))
        dt = next((step for step in steps if step is not None), None)
        if dt is None:
            if not predicts_rewards(model):
                name = type(unwrapped(model)).__name__
                raise ValueError(f"{name} does not say how long a step is: give dt=.")
            # predicts a whole trial, whatever its time
            dt = 1.0
    if not 0 < dt < np.inf:
        raise ValueError(f"dt = {dt!r} must be a finite time greater than 0.")
    return float(dt)


def checked_starts(initial_states: ArrayLike) -> Floats:
    """Initial states (n0, d_s)."""
    states = np.atleast_2d(np.array(initial_states, dtype=np.float64))
    if states.ndim != 2 or not states.size:
        raise ValueError(
            f"initial_states has shape {np.shape(initial_states)}; expected (n0, d_s)."
        )
    if not np.isfinite(states).all():
        raise ValueError("initial_states has NaN or infinite values.")
    return states


def checked_candidates(candidates: ArrayLike, horizon: int | None) -> Floats:
    """Candidates (m, p), or (m, horizon, d_a) where there is a horizon: sequences of actions."""
    given = np.asarray(candidates, dtype=np.float64)
    right = given.ndim == 2 if horizon is None else given.ndim == 3 and given.shape[1] == horizon
    if not right or not len(given):
        expected = "(m, p)" if horizon is None else f"(m, {horizon}, d_a)"
        raise ValueError(f"candidates have shape {given.shape}; expected {expected}.")
    if not np.isfinite(given).all():
        raise ValueError("candidates have NaN or infinite values.")
    return given


def check_width(model: Any, decision: str, bounds: Floats) -> None:
    """Whether bounds have a row for each action, or parameter, that a model was fitted with.

    Raises
    ------
    ValueError
    """
    inner = unwrapped(model)
    blocks = getattr(getattr(inner, "layout_", None), "columns", {})
    names = blocks.get("action" if decision == "actions" else "params")
    # in a pipeline, parameters may be transformed before the model sees them
    if names is None or (decision == "params" and inner is not model):
        return
    if len(names) != len(bounds):
        what, size = ("actions", "d_a") if decision == "actions" else ("params", "p")
        raise ValueError(
            f"bounds has {len(bounds)} rows, but {type(inner).__name__} was fitted with "
            f"{size} = {len(names)} {what} ({', '.join(names)}): give one row (lower, upper) for "
            "each."
        )


def check_answerable(
    model: Any, *, decision: str, constrained: bool, needs_actions: bool, every: int
) -> None:
    """Whether a model depends on the candidates and predicts what is asked about.

    Parameters
    ----------
    model : estimator
    decision : {"params", "actions"}
    constrained : bool
    needs_actions : bool
        Whether the reward names actions.
    every : int

    Raises
    ------
    NotFittedError
    ValueError
    """
    if hasattr(model, "fit"):
        check_is_fitted(unwrapped(model))
    name = type(unwrapped(model)).__name__
    if predicts_rewards(model):
        if constrained or decision == "actions":
            asked = "constraint=" if constrained else "decision='actions'"
            raise ValueError(f"{name} predicts rewards, not states, and so knows no {asked}.")
        return
    blocks = getattr(unwrapped(model), "layout_", None)
    if blocks is not None and decision == "actions" and "action" not in blocks:
        raise ValueError(
            f"decision='actions', but {name} was fitted without actions: search over params, or "
            "fit a one-step model of states and actions."
        )
    if blocks is not None and not {"params", "action"} & set(blocks):
        raise ValueError(
            f"{name} was fitted on episodes without params, so that nothing depends on the "
            "candidates: give params with the episodes."
        )
    if needs_actions and decision == "params" and every > 1:
        raise ValueError(
            "a reward that names actions needs the state before each step: use every=1."
        )
