"""The trial that a policy search predicts: like the last one that ran over the whole horizon."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.control._trials import Trials
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.times import uniform_step

__all__ = ["first_states", "future_known", "signals_of"]

Floats = NDArray[np.float64]


def first_states(data: TrajectoryDataset | None, given: ArrayLike | None) -> Floats:
    """States (n0, d_s) over which a return is averaged: as given, or those of all trials.

    Raises
    ------
    ValueError
        If there is neither.
    """
    if given is not None:
        return np.atleast_2d(np.asarray(given, dtype=np.float64))
    if data is None:
        raise ValueError("no trial was told, so give initial_states=.")
    first = data.states[data.offsets[:-1]]
    # trials that all begin alike need one prediction
    return first[:1] if (first == first[0]).all() else first


def future_known(state: Trials) -> bool:
    """Whether the references of the next trial are known, if it has any."""
    data = state.data
    return data is None or data.references is None or bool(data.lengths.max() >= state.horizon)


def signals_of(state: Trials) -> dict[str, Any]:
    """What is known of the next trial beside its first state, as settings of `PredictedReturn`.

    Raises
    ------
    ValueError
        If its references are unknown.
    """
    data = state.data
    if data is None:
        return {}
    if not future_known(state):
        raise ValueError(
            f"no trial ran over the horizon of {state.horizon} steps yet, so the references of the "
            "next one are unknown: tell one that did."
        )
    whole = np.flatnonzero(data.lengths >= state.horizon)
    last = data[int(whole[-1]) if len(whole) else -1]
    signals: dict[str, Any] = {
        "dt": uniform_step(data),
        "state_names": data.state_names,
        "start_time": float(last.times[0]),
        "context": dict(last.context),
    }
    if last.references is not None:
        signals["references"] = last.references
    if not np.isnan(last.time_origin):
        signals["phase"] = last.times[0] - last.time_origin
    return signals
