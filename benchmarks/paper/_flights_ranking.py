"""Ranking of held-out flights by their tracking error: direct models, and rank correlations."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_data import Flights, flights, folds, tracking_errors
from benchmarks.paper._flights_kernel import gain_scaler
from trajlearn import (
    DirectRewardGP,
    EpisodeRelabeler,
    GPRegressor,
    TrajectoryDataset,
    rank_correlation,
)

Floats = NDArray[np.float64]

WINDOWS = ("common", "full")
NEAREST = 3
#: Draws of experiments behind an interval.
N_BOOTSTRAP = 300
#: Rows of a cell, and what is compared with them.
DIRECT = ("direct GP", "nearest in time")


def cell(split: str, fold: int, seed: int) -> dict[str, Any]:
    """Tracking errors [m] of the test flights of a fold, predicted without their states.

    Returns
    -------
    dict
        ``flights``: ids of the test flights; ``rows``: of each of `DIRECT`, predictions by window.
    """
    every = flights()
    train, test = folds(every.ds, split)[fold]
    flown = tracking_errors(every.ds.states, every.ds, start_logged=every.start_logged)
    rows: dict[str, dict[str, Floats]] = {row: {} for row in DIRECT}
    for window in WINDOWS:
        log_error = np.log(flown[window])
        known = train[np.isfinite(log_error[train])]
        model = pooled_gp(seed).fit(with_target(every.ds[known], log_error[known]))
        rows["direct GP"][window] = np.exp(model.predict(every.ds[test]))
        rows["nearest in time"][window] = np.array(
            [nearest(every, known, i, flown[window]) for i in test]
        )
    return {"flights": every.ds.ids[test].tolist(), "rows": rows}


def pooled_gp(seed: int) -> DirectRewardGP:
    """One Gaussian process of the gains for all kinds of flights."""
    rows = EpisodeRelabeler(horizon=1, inputs=("params", "context"))
    model = DirectRewardGP(GPRegressor(kernel="matern52"), relabeler=rows, random_state=seed)
    return model.set_params(scaler__params=gain_scaler())


def with_target(ds: TrajectoryDataset, target: Floats) -> TrajectoryDataset:
    """Flights whose logged reward is the target at every step: its mean over one step is, too."""
    return ds.assign(rewards=[np.full(n, y) for n, y in zip(ds.lengths, target, strict=True)])


def nearest(every: Flights, known: NDArray[np.intp], flight: int, errors: Floats) -> float:
    """Mean error of the experiments that were flown nearest in time, of the same group.

    Parameters
    ----------
    every : Flights
    known : ndarray
        Numbers of the training flights.
    flight : int
    errors : ndarray of shape (n,)
        Of all flights; only those of `known` are read.
    """
    assert every.ds.group is not None  # flights have an experiment
    alike = known[every.group[known] == every.group[flight]]
    if not len(alike):
        return float("nan")
    by_experiment = pd.Series(errors[alike]).groupby(every.ds.group[alike]).mean()
    away = np.abs(by_experiment.index.to_numpy(dtype=float) - float(every.ds.group[flight]))
    closest = np.argsort(away, kind="stable")[:NEAREST]
    return float(by_experiment.to_numpy()[closest].mean())


def repeats(every: Flights, errors: Floats) -> Floats:
    """Mean error of the other flights with the same gains, of each flight; NaN without any."""
    key = pd.DataFrame(every.ds.params).assign(group=every.group).groupby("group")
    setting = pd.Series(-1, index=range(len(errors)))
    for _, some in key:
        gains = some.drop(columns="group")
        setting[some.index] = some.index[0] + gains.groupby(list(gains)).ngroup() * len(errors)
    there = np.isfinite(errors)
    table = pd.DataFrame({"setting": setting, "error": errors, "there": there})
    grouped = table.groupby("setting")
    total, count = grouped["error"].transform("sum"), grouped["there"].transform("sum")
    others = (count - 1).where(there & (count > 1))
    return ((total - table["error"]) / others).to_numpy(dtype=float)


def rankings(scores: pd.DataFrame) -> pd.DataFrame:
    """Rank correlations of each row, window, group and seed.

    Parameters
    ----------
    scores : DataFrame
        A line a split, row, window, seed and flight, with ``group``, ``fold``, ``experiment``,
        ``predicted`` and ``flown``.

    Returns
    -------
    DataFrame
        ``pooled`` and ``per_fold`` with the 90 % interval of `pooled` over experiments;
        ``log_error``, the root mean square of log predicted / flown; ``spread``, the standard
        deviation of log flown.
    """
    lines = []
    by = ["split", "window", "group", "row", "seed"]
    for key, some in scores.dropna(subset=["predicted", "flown"]).groupby(by, sort=False):
        found = rank_correlation(
            some["predicted"],
            some["flown"],
            folds=None if (some["fold"] < 0).all() else some["fold"],
            groups=some["experiment"],
            n_bootstrap=N_BOOTSTRAP,
            random_state=0,
        )
        with np.errstate(divide="ignore"):
            off = np.log(some["predicted"] / some["flown"])
        line = dict(zip(by, key, strict=True))
        line |= {k: found[k] for k in ("pooled", "pooled_lower", "pooled_upper", "per_fold")}
        line |= {"log_error": np.sqrt((off**2).mean()), "spread": np.log(some["flown"]).std()}
        lines.append(line | {"n": len(some)})
    return pd.DataFrame(lines)
