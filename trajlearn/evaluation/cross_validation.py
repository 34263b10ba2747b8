"""Cross-validation over episodes and horizons."""

import warnings
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, check_cv
from tqdm import tqdm

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._horizons import errors_at, predicted_states, whole_steps
from trajlearn.evaluation._matching import episode_of
from trajlearn.evaluation.errors import summarise
from trajlearn.regressors._threads import by_workers
from trajlearn.trajectories import TrajectoryDataset, as_dataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["cross_val_forecast", "cross_validate_horizons"]

Starts = ArrayLike | Sequence[ArrayLike]
Fold = tuple[NDArray[np.intp], NDArray[np.intp]]


def cross_validate_horizons(
    estimator: Any,
    ds: TrajectoryDataset,
    horizons: ArrayLike,
    *,
    cv: Any = 5,
    groups: ArrayLike | None = None,
    n_jobs: int | None = None,
    verbose: int = 0,
) -> "pd.DataFrame":
    """Error by horizon on held-out episodes.

    For each fold a clone of the estimator is fitted on the training episodes and forecasts each
    test episode from its first state. Only `fit` and `predict` are called, so that a `Pipeline`
    that ends in a dynamics estimator is as good.

    Parameters
    ----------
    estimator : dynamics estimator or Pipeline
        Not changed.
    ds : TrajectoryDataset or list of Trajectory
    horizons : int or array-like of int
        Steps ahead.
    cv : int, splitter or iterable of (train, test), default=5
        A number of folds means `GroupKFold` where there are groups, else `KFold`, shuffled with
        a fixed seed.
    groups : array-like of shape (n,), optional
        Labels of episodes that must not be parted. Default: ``ds.group``.
    n_jobs : int, optional
        Folds at once, as in joblib; each worker keeps to one thread.
    verbose : int, default=0
        Show a progress bar.

    Returns
    -------
    DataFrame
        One row a fold and horizon: ``fold``, ``horizon``, then as in `summarise`
        (``n_episodes``, ``n_diverged``, ``median``, ``mean``, ``q65``, ``q95``; the errors are in
        ranges of the training episodes of the fold). A fold without an episode that reaches a
        horizon has ``n_episodes`` 0 and NaN there. ``attrs`` as in `horizon_errors`.

    Raises
    ------
    ValueError
        If a horizon is not a whole number of steps, or longer than every test episode, or
        `groups` has the wrong length.
    TypeError
        If the estimator does not predict states.

    See Also
    --------
    cross_val_forecast : the forecasts themselves.
    horizon_scorer : one horizon, for `GridSearchCV`.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0)
    >>> table = cross_validate_horizons(model, ds, [1, 6], cv=3)
    >>> table[["fold", "horizon", "n_episodes", "n_diverged"]]
       fold  horizon  n_episodes  n_diverged
    0     0        1           3           0
    1     0        6           3           0
    2     1        1           3           0
    3     1        6           3           0
    4     2        1           3           0
    5     2        6           3           0
    >>> bool((table["median"] < 0.05).all())
    True
    """
    import pandas as pd

    ds = as_dataset(ds)
    steps = whole_steps(horizons, "horizons")
    folds = _folds(ds, cv, groups)
    longest = max(ds.lengths[test].max() for _, test in folds)
    if steps[-1] > longest:
        raise ValueError(
            f"horizons {steps[steps > longest].tolist()} are longer than every test episode (the "
            f"longest has {longest} steps): leave them out, or log longer episodes."
        )
    errors = _map_folds(_fold_errors, estimator, ds, folds, n_jobs, verbose, steps)
    tables = [summarise(fold).reset_index() for fold in errors]
    for i, table in enumerate(tables):
        table.insert(0, "fold", i)
    joined = pd.concat(tables, ignore_index=True)
    joined.attrs = dict(errors[0].attrs)
    reached = joined.groupby("horizon")["n_episodes"].sum()
    if (reached == 0).any():
        raise ValueError(
            f"no forecast reaches the horizons {reached.index[reached == 0].tolist()}, although "
            "test episodes do: where theta changes inside an episode, a trajectory model predicts "
            "to the end of the first stretch only. Leave these horizons out."
        )
    return joined


def cross_val_forecast(
    estimator: Any,
    ds: TrajectoryDataset,
    cv: Any = 5,
    *,
    groups: ArrayLike | None = None,
    n_jobs: int | None = None,
    verbose: int = 0,
    start: Starts = 0,
    **settings: Any,
) -> Forecast:
    """Forecast of each episode by a model that was not fitted on it.

    Parameters
    ----------
    estimator : dynamics estimator or Pipeline
        Not changed.
    ds : TrajectoryDataset or list of Trajectory
    cv, groups, n_jobs, verbose
        As in `cross_validate_horizons`; each episode must be in exactly one test set.
    start : int, array-like of shape (n,) or (n, k), or n arrays, default=0
        Index of the state to begin at: one, one per episode, or several per episode, as from
        `starts_every`.
    **settings
        Further arguments of `predict`, such as ``horizon=``, ``return_std=True``, ``n_samples=``.

    Returns
    -------
    Forecast
        In the order of `ds`; with several starts per episode its `episode` tells them apart.
        Its `state_range` spans the training states of all folds, whereas
        `cross_validate_horizons` scales the errors of each fold by the fold's own.

    Raises
    ------
    ValueError
        If an episode is tested never or twice, or `start` or `groups` has the wrong length.
    TypeError
        If the estimator does not predict states.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0)
    >>> cross_val_forecast(model, ds, cv=3)
    Forecast(n=9, H=6, d_s=1)
    """
    ds = as_dataset(ds)
    folds = _folds(ds, cv, groups)
    order = np.concatenate([test for _, test in folds])
    if not np.array_equal(np.sort(order), np.arange(len(ds))):
        raise ValueError(
            "cross_val_forecast needs every episode in exactly one test set; use a splitter such "
            "as KFold or GroupKFold."
        )
    starts: list[Any] = list(start) if np.iterable(start) else [start] * len(ds)
    if len(starts) != len(ds):
        raise ValueError(
            f"start has {len(starts)} entries for {len(ds)} episodes: give one index, one per "
            "episode, or an array of several per episode."
        )
    forecasts = _map_folds(_fold_forecast, estimator, ds, folds, n_jobs, verbose, starts, settings)
    episode = np.concatenate([test[episode_of(f)] for f, (_, test) in zip(forecasts, folds)])
    several = any(f.episode is not None for f in forecasts)
    joined: Any = np.concatenate([f._replace(episode=None) for f in forecasts])
    in_order = np.argsort(episode, kind="stable")
    return joined._replace(episode=episode if several else None)[in_order]


# -- one fold -----------------------------------------------------------------------------


def _fold_errors(
    estimator: Any, ds: TrajectoryDataset, fold: Fold, steps: NDArray[np.intp]
) -> "pd.DataFrame":
    train, test = fold
    return errors_at(estimator.fit(ds[train]), ds[test], steps)


def _fold_forecast(
    estimator: Any,
    ds: TrajectoryDataset,
    fold: Fold,
    starts: list[Any],
    settings: dict[str, Any],
) -> Forecast:
    train, test = fold
    start = [starts[i] for i in test]
    return predicted_states(estimator.fit(ds[train]), ds[test], start=start, **settings)


# -- all folds ----------------------------------------------------------------------------


def _folds(ds: TrajectoryDataset, cv: Any, groups: ArrayLike | None) -> list[Fold]:
    labels = ds.group if groups is None else np.asarray(groups)
    if labels is not None and labels.shape != (len(ds),):
        raise ValueError(
            f"groups has shape {labels.shape}: give one label an episode, ({len(ds)},)."
        )
    if isinstance(cv, Integral) and labels is not None:
        splitter = GroupKFold(int(cv))
    else:
        splitter = check_cv(cv, shuffle=True, random_state=0)
    with warnings.catch_warnings():
        if groups is None:
            # a splitter that has no use for the groups of the dataset was chosen knowingly
            warnings.filterwarnings("ignore", "The groups parameter is ignored", UserWarning)
        return list(splitter.split(ds, groups=labels))


def _map_folds(
    work: Callable[..., Any],
    estimator: Any,
    ds: TrajectoryDataset,
    folds: list[Fold],
    n_jobs: int | None,
    verbose: int,
    *args: Any,
) -> list[Any]:
    """``work(clone, ds, fold, *args)`` of each fold, in order."""
    jobs = [(clone(estimator), ds, fold, *args) for fold in folds]
    results = by_workers(work, jobs, n_jobs)
    return list(tqdm(results, total=len(folds), desc="folds", disable=not verbose))
