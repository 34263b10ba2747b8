"""Forecasts of different lengths as one."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from trajlearn.dynamics.forecast import Forecast

__all__ = ["PER_FORECAST", "joined"]

Floats = NDArray[np.float64]

# fields with one entry a forecast
PER_FORECAST = ("times", "lengths", "initial_states", "initial_times", "start", "diverged_at")


def joined(forecasts: Sequence["Forecast"]) -> "Forecast":
    """Forecasts episode after episode, padded to the longest horizon.

    Raises
    ------
    ValueError
        If they differ in states, actions or horizons, or only some of them have bands.
    """
    longest = max(forecasts, key=lambda forecast: len(forecast.horizons))
    n_horizons = len(longest.horizons)
    if any(f.episode is not None for f in forecasts):
        raise ValueError("forecasts with several starts an episode cannot be concatenated.")
    if any(
        f.actions != longest.actions or f.mean.shape[2] != longest.mean.shape[2] for f in forecasts
    ):
        raise ValueError(
            "the forecasts differ in their states or in where their actions came from."
        )
    for f in forecasts:
        if not np.array_equal(f.horizons, longest.horizons[: len(f.horizons)]):
            raise ValueError("the forecasts have different horizons, so they cannot be joined.")

    def padded(name: str, axis: int = 0) -> Floats | None:
        values = [getattr(forecast, name) for forecast in forecasts]
        if any(value is None for value in values):
            return None
        blocks = []
        for value in values:
            width = [(0, 0)] * value.ndim
            width[axis + 1] = (0, n_horizons - value.shape[axis + 1])
            blocks.append(np.pad(value, width, constant_values=np.nan))
        return np.concatenate(blocks, axis=axis)

    rest = {
        name: np.concatenate([getattr(forecast, name) for forecast in forecasts])
        for name in PER_FORECAST
        if name != "times"
    }
    bands = [f.bands for f in forecasts if f.bands is not None]
    if bands and len(bands) < len(forecasts):
        raise ValueError("some of the forecasts have conformal bands and others have none.")
    low = np.min([f.state_range[0] for f in forecasts], axis=0)
    high = np.max([f.state_range[1] for f in forecasts], axis=0)
    return longest._replace(
        mean=padded("mean"),
        std=padded("std"),
        raw_std=padded("raw_std"),
        samples=padded("samples", axis=1),
        times=padded("times"),
        state_range=np.stack([low, high]),
        bands=np.concatenate(bands) if bands else None,
        **rest,
    )
