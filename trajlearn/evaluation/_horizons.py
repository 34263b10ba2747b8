"""Errors of a fitted estimator at some horizons, by `predict` alone."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics import Forecast
from trajlearn.evaluation.errors import horizon_errors
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["errors_at", "predicted_states", "whole_steps"]


def whole_steps(horizons: ArrayLike, name: str) -> NDArray[np.intp]:
    """`horizons` as increasing whole numbers of steps, each once.

    Raises
    ------
    ValueError
        If one is not a whole number, or below 1.
    """
    values = np.atleast_1d(np.asarray(horizons))
    numbers = values.dtype.kind in "iuf" and values.ndim == 1 and len(values) > 0
    if not numbers or not np.isfinite(values).all() or (values != np.floor(values)).any():
        raise ValueError(
            f"{name} = {horizons!r}: horizons are whole numbers of steps, not times; divide a "
            "time by the time step."
        )
    if values.min() < 1:
        raise ValueError(f"{name} = {horizons!r}: a horizon is at least 1 step.")
    return np.unique(values).astype(np.intp)


def predicted_states(estimator: Any, ds: TrajectoryDataset, **settings: Any) -> Forecast:
    """``estimator.predict(ds, ...)``, which has to be a forecast.

    Raises
    ------
    TypeError
        If the estimator predicts something else, as a model of the reward does.
    """
    forecast = estimator.predict(ds, **settings)
    if not isinstance(forecast, Forecast):
        raise TypeError(
            f"{type(estimator).__name__}.predict returned {type(forecast).__name__}, not a "
            "Forecast: errors by horizon need a dynamics estimator (or a Pipeline that ends in "
            "one), which predicts states."
        )
    return forecast


def errors_at(estimator: Any, ds: TrajectoryDataset, horizons: NDArray[np.intp]) -> "pd.DataFrame":
    """Errors of the episodes `ds` at `horizons`; NaN where an episode does not reach one."""
    import pandas as pd

    # cut instead of horizon=: shorter episodes are then not forecast past their end
    ds = ds.truncate(int(horizons[-1]))
    errors = horizon_errors(predicted_states(estimator, ds), ds)
    return errors.reindex(columns=pd.Index(horizons, name="horizon"))
