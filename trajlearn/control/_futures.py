"""Asking a model what becomes of candidates: one interface to all that predict."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics._forecaster import Forecaster
from trajlearn.dynamics._members import unwrapped
from trajlearn.dynamics._planned import broadcast, by_episode, planned
from trajlearn.dynamics.direct_reward import DirectRewardGP, DirectRewardNN
from trajlearn.dynamics.forecast import Forecast
from trajlearn.trajectories import TrajectoryDataset

__all__ = [
    "References",
    "Situation",
    "ask_forecast",
    "ask_reward",
    "draws_from_generators",
    "later",
    "policy_of",
    "predicts_rewards",
    "reference_function",
]

Floats = NDArray[np.float64]
References = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Situation:
    """What a prediction starts from and what is known of its future.

    Attributes
    ----------
    initial_states : ndarray of shape (n0, d_s)
    horizons : ndarray of shape (k,)
        Times after the start.
    all_horizons : ndarray of shape (horizon,)
        The same of each step.
    policy : callable or None
    references : callable or None
        Times after the start (n,) to references (n, d_r).
    context : mapping
    phase : float or None
    state_names : tuple of str or None
        None takes those of the model.
    """

    initial_states: Floats
    horizons: Floats
    all_horizons: Floats
    policy: Any
    references: References | None
    context: Mapping[str, Any]
    phase: float | None
    state_names: tuple[str, ...] | None

    def starts(self, n: int) -> Floats:
        """The initial states once for each of n candidates (n * n0, d_s)."""
        return np.tile(self.initial_states, (n, 1))

    def repeated(self, values: Floats) -> Floats:
        """Values (n, ...) of each candidate, for each of its initial states."""
        return np.repeat(values, len(self.initial_states), axis=0)


def predicts_rewards(model: Any) -> bool:
    """Whether it is a direct reward model, which predicts no states."""
    return isinstance(unwrapped(model), (DirectRewardGP, DirectRewardNN))


def policy_of(model: Any, policy: Any) -> Any:
    """The policy that is given, or else that of the model; None if there is none."""
    if policy is not None:
        return policy
    inner = unwrapped(model)
    own = getattr(inner, "policy", None)
    # the name of one that the model has learned from its logs
    return getattr(inner, "policy_", None) if isinstance(own, str) else own


def draws_from_generators(model: Any) -> bool:
    """Whether a model takes numpy's generators for `random_state`, as this package's do."""
    return isinstance(unwrapped(model), Forecaster)


def ask_forecast(
    model: Any,
    situation: Situation,
    candidates: Floats,
    *,
    n_samples: int | None,
    random_state: Any,
) -> Forecast:
    """Forecast of each candidate from each initial state, row i * n0 + j.

    Parameters
    ----------
    model : estimator
        With `predict_trajectory`, or with a `predict` of episodes that takes its keywords.
    situation : Situation
    candidates : ndarray of shape (n, p), or (n, horizon, d_a) for actions
    n_samples : int or None
    random_state : int or Generator

    Raises
    ------
    TypeError
        If the model predicts something else.
    ValueError
        If a forecast ends before the last horizon.
    """
    name = "params" if candidates.ndim == 2 else "actions"
    settings: dict[str, Any] = {}
    if situation.policy is not None and name == "params":
        settings["policy"] = situation.policy
    if n_samples:
        settings |= {"n_samples": n_samples, "random_state": random_state}
    if hasattr(model, "predict_trajectory"):
        given: dict[str, Any] = {name: situation.repeated(candidates)}
        if situation.references is not None:
            given["references"] = situation.references
        if situation.context:
            given["context"] = situation.context
        if situation.phase is not None:
            given["phase"] = situation.phase
        forecast = model.predict_trajectory(
            situation.starts(len(candidates)), horizons=situation.horizons, **given, **settings
        )
    else:
        grid, chosen = _grid(model, situation)
        ds = _planned(model, situation, grid, candidates)
        if name == "actions":
            settings["actions"] = "logged"
        forecast = model.predict(ds, **settings)
        if not isinstance(forecast, Forecast):
            raise TypeError(
                f"{type(model).__name__} predicts {type(forecast).__name__}, not a Forecast: give "
                "a dynamics estimator, a Pipeline that ends in one, or a direct reward model."
            )
        if len(chosen) < len(grid):
            forecast = forecast.at(chosen + 1)
    if forecast.mean.shape[1] < len(situation.horizons) or (
        forecast.lengths.min() < len(situation.horizons)
    ):
        raise ValueError(
            f"{type(model).__name__} predicts {forecast.lengths.min()} of the "
            f"{len(situation.horizons)} horizons asked for: give a shorter horizon."
        )
    return forecast


def ask_reward(
    model: Any, situation: Situation, params: Floats, *, return_std: bool
) -> tuple[Floats, Floats | None]:
    """Mean reward per step (n * n0,) of a direct reward model, and its std.

    Parameters
    ----------
    model : estimator
    situation : Situation
    params : ndarray of shape (n, p)
    return_std : bool
    """
    if hasattr(model, "layout_") and "context" not in model.layout_:
        starts = situation.starts(len(params))
        X: Any = np.concatenate([starts, situation.repeated(params)], axis=1)
    else:
        X = _planned(model, situation, situation.horizons[-1:], params)
    if not return_std:
        return np.asarray(model.predict(X)).ravel(), None
    mean, std = model.predict(X, return_std=True)
    return np.asarray(mean).ravel(), np.asarray(std).ravel()


def reference_function(
    references: ArrayLike | Callable[[Floats], ArrayLike],
    dt: float,
    horizon: int,
    start_time: float,
) -> References:
    """References as a function of time, from a function or from values at each step.

    Values count from `start_time`.

    Raises
    ------
    ValueError
        If there is not a row for each step from the initial state on; when called, if the times
        are beyond the rows.
    """
    if callable(references):
        function = references
        return lambda times: np.asarray(function(times), dtype=np.float64)
    values = np.asarray(references, dtype=np.float64)
    if values.ndim != 2 or len(values) <= horizon or not np.isfinite(values).all():
        raise ValueError(
            f"references has shape {values.shape}; expected finite values of shape "
            f"({horizon + 1} or more, d_r): one row a step, that of the initial state first; or "
            "a callable of times."
        )
    times = start_time + dt * np.arange(len(values))

    def interpolated(at: Floats) -> Floats:
        if at.max() > times[-1] + 1e-6 * dt or at.min() < times[0] - 1e-6 * dt:
            raise ValueError(
                f"references has {len(values)} rows, from time {times[0]:g} to {times[-1]:g}, but "
                f"is needed from {at.min():g} to {at.max():g}: give more rows, or a callable of "
                "times."
            )
        return np.stack([np.interp(at, times, column) for column in values.T], axis=1)

    return interpolated


def later(policy: Any, references: References | None, start_time: float) -> tuple[Any, Any]:
    """Policy and references for a model that counts time from the start."""
    if not start_time:
        return policy, references

    def act(states: Floats, params: Floats, times: Floats) -> Any:
        return policy(states, params, times + start_time)

    def refer(times: Floats) -> Floats:
        assert references is not None  # else nobody calls this
        return references(times + start_time)

    return None if policy is None else act, None if references is None else refer


def _grid(model: Any, situation: Situation) -> tuple[Floats, NDArray[np.intp]]:
    """Times that the model is to pass through, and which of them are the horizons."""
    inner = unwrapped(model)
    if not hasattr(inner, "planning_grid"):
        steps = np.searchsorted(situation.all_horizons, situation.horizons)
        return situation.all_horizons, steps
    grid, chosen = inner.planning_grid(
        situation.horizons, references=situation.references is not None
    )
    return grid, chosen


def _planned(
    model: Any, situation: Situation, grid: Floats, candidates: Floats
) -> TrajectoryDataset:
    """Episodes that have only begun, of each candidate from each initial state."""
    states, rows = situation.starts(len(candidates)), situation.repeated(candidates)
    n, references = len(rows), None
    if situation.references is not None:
        references = situation.references(np.append(0.0, grid))
    return planned(
        states,
        np.append(0.0, grid),
        params=rows if rows.ndim == 2 else None,
        actions=np.ascontiguousarray(rows[:, : len(grid)]) if rows.ndim == 3 else None,
        references=broadcast(references, (n, len(grid) + 1), "references"),
        context={key: by_episode(value, n, key) for key, value in situation.context.items()},
        phase=by_episode(np.nan if situation.phase is None else situation.phase, n, "phase"),
        state_names=situation.state_names or _state_names(model, states.shape[1]),
    )


def _state_names(model: Any, width: int) -> tuple[str, ...]:
    """Names of the states that a model, or the first transformer before it, was fitted with."""
    steps = [step for _, step in getattr(model, "steps", [])]
    for step in [*steps, unwrapped(model)]:
        names = getattr(step, "state_names_", ())
        if len(names) == width:
            return tuple(names)
    return tuple(f"s{i}" for i in range(width))
