"""Episodes that have only begun: what a plan says about their future."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import Columns

__all__ = ["broadcast", "by_episode", "planned"]

Floats = NDArray[np.float64]


def planned(
    initial_states: Floats,
    times: Floats,
    *,
    params: Floats | None,
    actions: Floats | None,
    references: Floats | None,
    context: dict[str, NDArray[Any]],
    phase: Floats,
    state_names: tuple[str, ...],
) -> TrajectoryDataset:
    """Episodes that have only begun: known future signals, and no state but the first.

    Built without a loop over episodes, for planning over thousands of candidates.
    """
    n, n_states = len(initial_states), len(times)
    columns = Columns(
        offsets=np.arange(n + 1) * n_states,
        states=np.repeat(initial_states, n_states, axis=0),
        times=np.tile(times, n),
        terminated=np.zeros(n, dtype=bool),
        time_origin=-phase.astype(np.float64),
        ids=np.arange(n),
        actions=None if actions is None else actions.reshape(-1, actions.shape[-1]),
        params=None if params is None or not params.shape[1] else params,
        references=None if references is None else references.reshape(-1, references.shape[-1]),
        context=context,
    )
    names = {
        "states": state_names,
        "actions": _numbered("a", actions),
        "params": _numbered("theta", columns.params),
        "references": _numbered("ref", references),
    }
    return TrajectoryDataset._of(columns, names)


def _numbered(prefix: str, values: Floats | None) -> tuple[str, ...]:
    return () if values is None else tuple(f"{prefix}{i}" for i in range(values.shape[-1]))


def broadcast(values: ArrayLike | None, shape: tuple[int, ...], name: str) -> Floats | None:
    """Values of one episode, or of each, as an array with the leading axes `shape`."""
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    if array.ndim not in (len(shape), len(shape) + 1):
        raise ValueError(f"{name} has shape {array.shape}; expected {(*shape, '...')}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has NaN or infinite values.")
    try:
        return np.ascontiguousarray(np.broadcast_to(array, (*shape, array.shape[-1])))
    except ValueError:
        raise ValueError(
            f"{name} has shape {array.shape}; expected {(*shape, array.shape[-1])}."
        ) from None


def by_episode(value: Any, n: int, name: str) -> NDArray[Any]:
    """One value for each of n episodes, from one for all or one each."""
    values = np.asarray(value)
    if name == "phase" and values.dtype.kind not in "iuf":
        raise ValueError(f"phase = {value!r} must be a number, a time.")
    if values.ndim == 0:
        values = np.full(n, values)
    if values.shape != (n,):
        raise ValueError(f"{name} has shape {values.shape}: give one value, or {n} of them.")
    return values
