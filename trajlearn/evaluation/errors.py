"""Errors of forecasts by horizon, and of predicted rewards."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._matching import (
    check_same_times,
    check_truth_kind,
    episode_of,
    matched_scores,
    with_states_of,
)
from trajlearn.evaluation._statistics import mean, quantile
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["horizon_errors", "reward_errors", "summarise"]


def horizon_errors(
    forecast: Forecast, truth: TrajectoryDataset, *, truth_kind: str = "observed"
) -> "pd.DataFrame":
    """Squared error of each forecast at each horizon.

    States are scaled to [0, 1] by their range over the training states, and the squared error is
    averaged over the state dimensions, so that an error has no unit and 0.01 means off by a
    tenth of the training range.

    Parameters
    ----------
    forecast : Forecast
        From ``forecast(ds)`` or ``predict(ds)``.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order. Where they have more states than the
        forecast (a pipeline selected some), those of the same names are compared.
    truth_kind : {"observed", "true"}, default="observed"
        What the states in `truth` are, for the record: measurements, or the noise-free states
        that a simulator knows.

    Returns
    -------
    DataFrame of shape (n, H)
        Index ``episode`` (the ids of `truth`), or ``(episode, start)`` where episodes have
        several starts; columns ``horizon`` in steps. NaN where there is no such step, +inf from
        the divergence of a forecast on. ``attrs`` holds ``truth`` (`truth_kind`) and ``actions``
        (where a roll-out took its actions from).

    Raises
    ------
    ValueError
        If the episodes are not those that were forecast, or the forecast is over times instead
        of steps.

    See Also
    --------
    summarise : median, mean and quantiles by horizon.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> states = [np.linspace(0, slope, 5)[:, None] for slope in (1.0, 2.0)]
    >>> ds = TrajectoryDataset.from_arrays(states, params=[[1.0], [2.0]])
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(ds)
    >>> errors = horizon_errors(model.predict(ds, horizon=3), ds)
    >>> errors.shape, errors.columns.tolist()
    ((2, 3), [1, 2, 3])
    """
    import pandas as pd

    check_truth_kind(truth_kind)
    ds = with_states_of(forecast, truth)
    errors = forecast.squared_errors(ds).mean(axis=2)
    check_same_times(forecast, ds)
    index = pd.Index(ds.ids[episode_of(forecast)], name="episode")
    if forecast.episode is not None:
        index = pd.MultiIndex.from_arrays([index, forecast.start], names=["episode", "start"])
    table = pd.DataFrame(errors, index, pd.Index(forecast.horizons, name="horizon"))
    table.attrs = {"truth": truth_kind, "actions": forecast.actions}
    return table


def summarise(errors: "pd.DataFrame") -> "pd.DataFrame":
    """Median, mean, 65th and 95th percentile of the errors at each horizon.

    A diverged forecast is an infinite error and counts as such: one of them makes the mean
    infinite, and a percentile that falls on (or is interpolated towards) one is infinite. Only
    steps that an episode does not have are left out.

    Parameters
    ----------
    errors : DataFrame of shape (n, H)
        As from `horizon_errors`.

    Returns
    -------
    DataFrame of shape (H, 6)
        Index ``horizon``; columns ``n_episodes`` (that reach the horizon), ``n_diverged``
        (episodes with a forecast that has diverged by then), ``median``, ``mean``, ``q65``,
        ``q95``. Where episodes have several starts the statistics are over all forecasts; for
        those over episodes pass ``errors.groupby(level="episode", sort=False).mean()``.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> errors = pd.DataFrame({1: [0.0, 0.1, 0.2], 2: [0.2, np.inf, np.nan]})
    >>> summarise(errors)[["n_episodes", "n_diverged", "median", "mean"]]
             n_episodes  n_diverged  median  mean
    horizon
    1                 3           0     0.1   0.1
    2                 2           1     inf   inf
    """
    import pandas as pd

    values = errors.to_numpy(dtype=np.float64)
    present, diverged = errors.notna(), errors == np.inf
    if isinstance(errors.index, pd.MultiIndex):
        present = present.groupby(level="episode").any()
        diverged = diverged.groupby(level="episode").any()
    table = pd.DataFrame(
        {
            "n_episodes": present.to_numpy().sum(axis=0),
            "n_diverged": diverged.to_numpy().sum(axis=0),
            "median": quantile(values, 0.5),
            "mean": mean(values),
            "q65": quantile(values, 0.65),
            "q95": quantile(values, 0.95),
        },
        index=pd.Index(errors.columns, name="horizon"),
    )
    table.attrs = dict(errors.attrs)
    return table


def reward_errors(predicted: ArrayLike, true: ArrayLike) -> dict[str, float]:
    """Squared error of predicted rewards.

    Parameters
    ----------
    predicted : array-like of shape (n,)
        One reward an episode; infinite where the forecast diverged.
    true : array-like of shape (n,)
        Finite.

    Returns
    -------
    dict
        ``mean``, ``std`` (over the n squared errors, not of the mean) and ``median`` of the
        squared error, ``n_episodes`` and ``n_diverged``. A diverged forecast makes mean and std
        infinite; the median says what the typical episode is like.

    Raises
    ------
    ValueError
        If the shapes are not the same (n,): subtracting (n, 1) from (n,) would quietly compare
        every episode with every other. If a value is NaN or a true reward infinite.

    Examples
    --------
    >>> errors = reward_errors([0.5, 1.0, 2.0], [0.5, 1.0, 1.0])
    >>> errors["median"], round(errors["mean"], 3), errors["n_diverged"]
    (0.0, 0.333, 0)
    """
    guess, target = matched_scores(predicted, true, "reward")
    squared = (guess - target) ** 2
    n_diverged = int(np.isinf(guess).sum())
    return {
        "mean": float(squared.mean()),
        "std": float("inf") if n_diverged else float(squared.std()),
        "median": float(quantile(squared[:, None], 0.5)[0]),
        "n_episodes": len(squared),
        "n_diverged": n_diverged,
    }
