"""Errors of forecasts by state and horizon, in the units of the states."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._horizons import whole_steps
from trajlearn.evaluation._matching import (
    check_same_times,
    check_truth_kind,
    episode_of,
    with_states_of,
)
from trajlearn.evaluation._statistics import mean, mean_by, quantile
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["state_errors"]

Floats = NDArray[np.float64]


def state_errors(
    forecast: Forecast,
    truth: TrajectoryDataset,
    *,
    horizons: ArrayLike | None = None,
    norms: Mapping[str, Sequence[str]] | None = None,
    reference: Forecast | None = None,
    truth_kind: str = "observed",
) -> "pd.DataFrame":
    """Error of each state at each horizon, in its own unit.

    `horizon_errors` averages over states in training ranges, which wide but unpredictable states
    such as rates dominate; here every state stands for itself. The error of an episode is the
    root mean square over its starts, so that an episode with many starts counts no more than one
    with few; the columns summarise those of all episodes.

    Parameters
    ----------
    forecast : Forecast
        From ``forecast(ds)`` or ``predict(ds)``.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order.
    horizons : int or array-like of int, optional
        Steps ahead; default: all of the forecast.
    norms : mapping from name to state names, optional
        Euclidean errors over several states of one unit, as further states: with
        ``{"xy": ("x", "y")}`` the distance in the plane.
    reference : Forecast, optional
        Another forecast of the same starts, such as that of the mean episode, to measure the
        skill against.
    truth_kind : {"observed", "true"}, default="observed"
        What the states in `truth` are, for the record.

    Returns
    -------
    DataFrame
        One row a state (norms last) and horizon: ``state``, ``horizon``, ``n_episodes`` (that
        reach it), ``n_diverged`` (of them, with a forecast that has diverged by then), ``rmse``
        (root mean square over episodes), ``mae`` (mean absolute error), ``median`` and ``q95``
        over episodes, and, with `reference`, ``skill`` = 1 - MSE / MSE of the reference: 1 is
        perfect, 0 as good as the reference, below 0 worse. Steps that an episode does not have
        are left out; a diverged forecast is an infinite error. The skill compares the steps that
        both forecasts have; it is NaN where the reference has diverged. ``attrs`` as in
        `horizon_errors`.

    Raises
    ------
    ValueError
        If the episodes or the starts of the reference are not those that were forecast, a
        horizon was not, or a norm names no state.

    Notes
    -----
    Differences of angles are taken as they are: unwrap angles when the dataset is built.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.array([[1.0, 3.0], [2.0, 4.0]])
    >>> states = slopes[:, None] * np.arange(5.0)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(states, state_names=["x", "y"])
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(ds)
    >>> table = state_errors(model.predict(ds), ds, horizons=[1, 4], norms={"xy": ("x", "y")})
    >>> table[["state", "horizon", "n_episodes"]]
      state  horizon  n_episodes
    0     x        1           2
    1     x        4           2
    2     y        1           2
    3     y        4           2
    4    xy        1           2
    5    xy        4           2
    """
    import pandas as pd

    check_truth_kind(truth_kind)
    if horizons is not None:
        forecast = forecast.at(whole_steps(horizons, "horizons"))
    errors = _squared(forecast, truth)
    members = _members(tuple(errors), norms or {})
    squared = _combined(errors, members)
    episode = episode_of(forecast)
    by_episode = mean_by(squared, episode)
    root = np.sqrt(by_episode)
    columns = {
        "n_episodes": (~np.isnan(by_episode)).sum(axis=0),
        "n_diverged": np.isinf(by_episode).sum(axis=0),
        "rmse": np.sqrt(mean(by_episode)),
        "mae": mean(mean_by(np.sqrt(squared), episode)),
        "median": quantile(root, 0.5),
        "q95": quantile(root, 0.95),
    }
    if reference is not None:
        _check_same_starts(forecast, reference)
        others = _squared(reference.at(forecast.horizons), truth)
        missing = [name for name in errors if name not in others]
        if missing:
            raise ValueError(f"the reference has no forecast of the states {missing}.")
        columns["skill"] = _skill(squared, _combined(others, members), episode)
    table = pd.DataFrame(
        {
            "state": np.repeat(list(members), len(forecast.horizons)),
            "horizon": np.tile(forecast.horizons, len(members)),
        }
        | {name: values.T.ravel() for name, values in columns.items()}
    )
    table.attrs = {"truth": truth_kind, "actions": forecast.actions}
    return table


def _members(
    state_names: tuple[str, ...], norms: Mapping[str, Sequence[str]]
) -> dict[str, tuple[str, ...]]:
    """States of each row of the table: itself, or those of a norm."""
    for name, states in norms.items():
        if name in state_names:
            raise ValueError(f"the norm {name!r} has the name of a state; give it another.")
        unknown = [state for state in states if state not in state_names]
        if isinstance(states, str) or unknown or not len(states):
            raise ValueError(
                f"norms[{name!r}] = {states!r} must be a sequence of states that were forecast: "
                f"{', '.join(state_names)}."
            )
    return {name: (name,) for name in state_names} | {k: tuple(v) for k, v in norms.items()}


def _squared(forecast: Forecast, truth: TrajectoryDataset) -> dict[str, Floats]:
    """Squared errors (n, H) of each state in its own unit."""
    ds = with_states_of(forecast, truth)
    unit = np.repeat([[0.0], [1.0]], len(forecast.state_names), axis=1)
    squared = forecast._replace(state_range=unit).squared_errors(ds)
    check_same_times(forecast, ds)
    return {name: squared[..., j] for j, name in enumerate(ds.state_names)}


def _combined(errors: Mapping[str, Floats], members: Mapping[str, Sequence[str]]) -> Floats:
    """Squared errors (n, H, number of members), summed over the states of each."""
    return np.stack(
        [np.sum([errors[name] for name in names], axis=0) for names in members.values()], axis=-1
    )


def _check_same_starts(forecast: Forecast, reference: Forecast) -> None:
    same = len(forecast) == len(reference) and all(
        np.array_equal(of(forecast), of(reference)) for of in (episode_of, lambda f: f.start)
    )
    if not same:
        raise ValueError(
            "the reference forecasts other episodes or starts: predict(ds, start=...) has to be "
            "called with the same ds and start for both."
        )


def _skill(squared: Floats, reference: Floats, episode: NDArray[np.intp]) -> Floats:
    absent = np.isnan(squared) | np.isnan(reference)
    mse, of_reference = (
        mean(mean_by(np.where(absent, np.nan, values), episode)) for values in (squared, reference)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.isinf(of_reference), np.nan, 1 - mse / of_reference)
