"""Flights on a common grid of phases, and one flight with its forecasts, for the eye."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_data import (
    COMMON_FROM,
    Flights,
    flights,
    folds,
    predicted_states,
    tracking_errors,
)
from benchmarks.paper._flights_models import build
from trajlearn import TrajectoryDataset

Floats = NDArray[np.float64]

_STEP = 0.02
ROWS = ("mean flight", "T, tracking error", "C")
SHOWN = ("y", "roll")
_KIND = "line_y, upgraded motors"


def on_phases(ds: TrajectoryDataset) -> Floats:
    """States (n, n_phases, d_s) of flights of one kind, over the phases that all of them have."""
    origin = ds.time_origin
    end = (ds.times[ds.offsets[1:] - 1] - origin).min()
    begin = max(COMMON_FROM[ds.context["kind"][0]], (ds.times[ds.offsets[:-1]] - origin).max())
    grid = np.arange(begin, end, _STEP)
    curves = np.empty((len(ds), len(grid), ds.states.shape[1]))
    for i, (low, high) in enumerate(zip(ds.offsets[:-1], ds.offsets[1:], strict=True)):
        phase = ds.times[low:high] - origin[i]
        for j in range(curves.shape[2]):
            curves[i, :, j] = np.interp(grid, phase, ds.states[low:high, j])
    return curves


def cell(split: str, fold: int, mode: str, seed: int) -> dict[str, Any]:
    """A test flight from the beginning of its motion, and what models predict of it.

    The one whose tracking error is the median of its fold: no model chooses it.
    """
    every = flights()
    train, test = folds(every.ds, split)[fold]
    ds = every.ds[[_usual(every, test)]]
    begin = int(np.searchsorted(ds.times, ds.time_origin[0]))
    result: dict[str, Any] = {"flight": ds.ids[0], "phase": ds.times[begin:] - ds.time_origin[0]}
    columns = [ds.state_names.index(name) for name in SHOWN]
    assert ds.references is not None  # the flights have a set-point
    reference = np.c_[ds.references[begin:, 1], np.zeros(len(ds.times) - begin)]
    curves = {"flown": ds.states[begin:, columns], "set-point": reference}
    for row in ROWS:
        model = build(row, mode, seed).fit(every.ds[train])
        curves[row] = predicted_states(model, ds)[begin:, columns]
    return result | {"curves": curves}


def _usual(every: Flights, test: NDArray[np.intp]) -> int:
    """Number of the test flight of the main group whose tracking error is the median."""
    begun = test[every.start_logged[test] & (every.group[test] == _KIND)]
    ds = every.ds[begun]
    flown = tracking_errors(ds.states, ds, start_logged=np.ones(len(ds), dtype=bool))
    return int(begun[np.argsort(flown["full"], kind="stable")[len(begun) // 2]])


def example_table(result: dict[str, Any]) -> pd.DataFrame:
    """A line a curve and phase [s], from the result of the cell."""
    lines = []
    for row, curve in result["curves"].items():
        values = np.array(curve, dtype=float)
        head = {"flight": result["flight"], "row": row, "phase": result["phase"]}
        lines.append(pd.DataFrame(head | dict(zip(SHOWN, values.T, strict=True))))
    return pd.concat(lines, ignore_index=True)
