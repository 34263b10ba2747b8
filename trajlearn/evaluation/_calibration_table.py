"""Tidy tables of measures of calibration."""

from collections.abc import Hashable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from trajlearn.evaluation._bootstrap import EpisodeBootstrap, bounds, horizon_bins
from trajlearn.evaluation._cells import Cells
from trajlearn.evaluation._matching import check_truth_kind, episode_of
from trajlearn.evaluation._measures import Measures

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Bins", "CalibrationTable"]

Floats = NDArray[np.float64]
Bins = str | Sequence[tuple[int, int]] | None


class CalibrationTable:
    """Rows (bin, state, statistic) of statistics (1 + n_bootstrap, n_bins, k + 1)."""

    def __init__(
        self,
        cells: Cells,
        bins: Bins,
        truth_kind: str,
        n_bootstrap: int,
        confidence: float,
        distribution: str,
        random_state: int | RandomState | None,
    ) -> None:
        check_truth_kind(truth_kind)
        if isinstance(n_bootstrap, bool) or int(n_bootstrap) != n_bootstrap or n_bootstrap < 0:
            raise ValueError(f"n_bootstrap = {n_bootstrap!r} must be a whole number, at least 0.")
        if not 0 < confidence < 1:
            raise ValueError(f"confidence = {confidence!r} must lie between 0 and 1.")
        forecast = cells.forecast
        chosen = cells.chosen(distribution)
        self._bins = horizon_bins(forecast.horizons, bins)
        bootstrap = EpisodeBootstrap(
            episode_of(forecast), self._bins, int(n_bootstrap), random_state
        )
        self.measures = Measures(cells, bootstrap, chosen)
        self._states = ("all", *cells.names)
        self._confidence = confidence
        self._keys: list[dict[str, Any]] = []
        self._found: list[tuple[Floats, Floats, Floats]] = []
        self._attrs: dict[Hashable | None, Any] = {
            "truth": truth_kind,
            "actions": forecast.actions,
            "calibrated": cells.calibrated,
            "distribution": chosen,
            "confidence": confidence,
            "n_bootstrap": n_bootstrap,
            "units": "training ranges",
        }

    def add(self, measure: str, statistics: Iterable[Floats], **keys: Iterable[float]) -> None:
        """One row a bin and state for each statistic, with its keys."""
        each = [dict(zip(keys, values)) for values in zip(*keys.values())] or [{}]
        for key, statistic in zip(each, statistics):
            self._keys.append({"measure": measure} | key)
            self._found.append((statistic[0], *bounds(statistic, self._confidence)))

    def frame(self, columns: dict[str, type]) -> "pd.DataFrame":
        """The rows: bins, then states (all first), then statistics in the order of `add`."""
        import pandas as pd

        of_state = np.roll(np.arange(len(self._states)), 1)  # pooled first
        shape = (len(self._bins), len(self._states), len(self._keys))

        def ravelled(values: Floats) -> Floats:
            """Each row's value, of (n_bins, k + 1)."""
            return np.broadcast_to(values[:, of_state, None], shape).ravel()

        n_episodes = ravelled(self.measures.n_episodes)
        table: dict[str, Any] = {
            "first": np.repeat([b.first for b in self._bins], shape[1] * shape[2]),
            "last": np.repeat([b.last for b in self._bins], shape[1] * shape[2]),
            "state": np.tile(np.repeat(self._states, shape[2]), shape[0]),
        }
        for name, kind in columns.items():
            values = [key.get(name, np.nan) for key in self._keys]
            table[name] = np.tile(np.array(values, dtype=kind), shape[0] * shape[1])
        for name, part in zip(("value", "low", "high"), zip(*self._found)):
            stacked = np.full(shape, np.nan)
            for j, found in enumerate(part):
                # a statistic of the joint state has one column, that of "all"
                order = of_state if found.shape[1] > 1 else [0]
                stacked[:, : found.shape[1], j] = found[:, order]
            table[name] = stacked.ravel()
            if name != "value":
                # resamples of one episode are all alike
                table[name] = np.where(n_episodes > 1, table[name], np.nan)
        table["n_episodes"] = n_episodes
        table["n_diverged"] = ravelled(self.measures.n_diverged)
        joint = np.array([found[0].shape[1] == 1 for found in self._found])
        kept = np.broadcast_to(~joint | (np.arange(shape[1]) == 0)[:, None], shape).ravel()
        rows = pd.DataFrame(table)[kept].reset_index(drop=True)
        rows.attrs = self._attrs
        return rows
