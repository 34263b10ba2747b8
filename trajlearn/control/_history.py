"""Trials of a search as a table."""

from typing import TYPE_CHECKING

import numpy as np

from trajlearn.control._trials import Trials
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["history_of"]


def history_of(
    state: Trials, terminal_reward: float | None, data: TrajectoryDataset
) -> "pd.DataFrame":
    """One row a trial, see `Search.history`."""
    import pandas as pd

    records, returns = state.records, state.returns(terminal_reward)
    best = np.maximum.accumulate(np.where(np.isnan(returns), -np.inf, returns))
    columns = {
        "return": returns,
        "best": np.where(np.isinf(best), np.nan, best),
        "predicted": records["predicted"],
        "expected": records["expected"],
        "predicted_std": records["std"],
        "violation": records["violation"],
        "n_steps": data.lengths,
        "terminated": data.terminated,
        "source": records["source"].astype(object),
    }
    params = {
        f"params.{name}" if name in (*columns, "trial") else name: values
        for name, values in zip(data.param_names, records["params"].T, strict=True)
    }
    return pd.DataFrame({"trial": np.arange(len(data)), **params, **columns})
