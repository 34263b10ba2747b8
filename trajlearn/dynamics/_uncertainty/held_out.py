"""Forecasts of episodes by models that were not fitted on them, and their residuals."""

import warnings
from collections.abc import Iterator
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.model_selection import GroupKFold, GroupShuffleSplit, check_cv

from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.dynamics._uncertainty.calibration import Residuals
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import CalibrationWarning, NoUncertaintyError
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["fit_and_forecast", "residuals_of", "splits"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def _is_share(cv: Any) -> bool:
    return isinstance(cv, Real) and not isinstance(cv, Integral)


def splits(ds: TrajectoryDataset, cv: Any, rng: np.random.Generator) -> Iterator[tuple[Ints, Ints]]:
    """Episodes to fit on and episodes held out: one pair, or one a fold.

    Raises
    ------
    ValueError
        If there are too few episodes (groups) to hold any out, or an episode is held out twice.
    """
    seed = int(rng.integers(2**31))
    labels = ds.group
    units = np.unique(np.arange(len(ds)) if labels is None else labels, return_inverse=True)[1]
    n_units = int(units.max()) + 1
    if n_units < 2:
        raise ValueError(
            f"calibration holds out whole {'episodes' if labels is None else 'groups'}, and there "
            f"is only {n_units}: give more, or calibrate a fitted model on other episodes: "
            "CalibratedForecaster(FrozenEstimator(model)).fit(episodes)."
        )
    if _is_share(cv):
        # so that one unit is left to fit on, however large the share
        held_out = min(int(np.ceil(cv * n_units - 1e-9)), n_units - 1)
        splitter: Any = GroupShuffleSplit(1, test_size=held_out, random_state=seed)
    elif labels is not None and (cv is None or isinstance(cv, Integral)):
        splitter = GroupKFold(5 if cv is None else int(cv), shuffle=True, random_state=seed)
    else:
        splitter = check_cv(cv, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # a splitter that has no use for groups was chosen knowingly
        warnings.filterwarnings("ignore", "The groups parameter is ignored", UserWarning)
        folds = list(splitter.split(ds, groups=units))
    tested = np.zeros(len(ds), dtype=np.intp)
    for train, test in folds:
        tested[test] += 1
        if tested.max() > 1:
            raise ValueError(
                f"cv = {cv!r} holds out an episode twice, but each is to count once: take a "
                "splitter such as KFold or GroupKFold."
            )
        yield np.asarray(train), np.asarray(test)


def fit_and_forecast(
    estimator: Any, ds: TrajectoryDataset, *, cv: Any, start: int | str, rng: np.random.Generator
) -> tuple[Any, Forecast, TrajectoryDataset]:
    """Fit an estimator, and forecast episodes that it was not fitted on.

    Parameters
    ----------
    estimator : dynamics estimator or Pipeline
        A `FrozenEstimator` is not fitted and forecasts all episodes.
    ds : TrajectoryDataset
    cv, start
        As in `CalibratedForecaster`.
    rng : Generator

    Returns
    -------
    fitted : estimator
        On the episodes that are not held out, or on all if `cv` is not a share.
    forecast : Forecast
        One of each episode that goes beyond its start, with `std` if the estimator has one.
    truth : TrajectoryDataset
        These episodes.
    """
    if isinstance(estimator, FrozenEstimator):
        return estimator, *_forecast(estimator, ds, start, rng)
    unfitted, fitted = seeded(estimator, rng), None
    parts = []
    for train, test in splits(ds, cv, rng):
        fitted = clone(unfitted).fit(ds[train])
        parts.append(_forecast(fitted, ds[test], start, rng))
    forecasts, truths = zip(*parts)
    if len({forecast.std is None for forecast in forecasts}) > 1:
        raise ValueError("the estimator gives a standard deviation in some folds, not in others.")
    joined: Any = np.concatenate(forecasts) if len(parts) > 1 else forecasts[0]
    if not _is_share(cv):
        fitted = unfitted.fit(ds)
    return fitted, joined, truths[0].concatenate(*truths[1:])


def _forecast(
    model: Any, ds: TrajectoryDataset, start: int | str, rng: np.random.Generator
) -> tuple[Forecast, TrajectoryDataset]:
    """One forecast of each episode that is long enough, and these episodes."""
    starts = rng.integers(0, ds.lengths) if start == "random" else np.full(len(ds), start)
    long = ds.lengths > starts
    if not long.all():
        if not long.any():
            raise ValueError(
                f"no held-out episode goes beyond start = {start} (the longest has "
                f"{ds.lengths.max()} steps): calibrate from an earlier start."
            )
        warnings.warn(
            f"{(~long).sum()} of {len(ds)} held-out episodes end at start = {start} or "
            "before, and do not calibrate.",
            CalibrationWarning,
            stacklevel=5,
        )
        ds, starts = ds[long], starts[long]
    settings: dict[str, Any] = {"start": starts, "random_state": int(rng.integers(2**31))}
    try:
        forecast = model.predict(ds, return_std=True, **settings)
    except NoUncertaintyError:
        forecast = model.predict(ds, **settings)
    except ValueError as error:
        # an estimator written elsewhere may say so in other ways; an error of predict comes again
        forecast = model.predict(ds, **settings)
        warnings.warn(
            f"{type(model).__name__} failed with return_std=True ({error}) and without it did not: "
            "it is calibrated as a model without a standard deviation.",
            CalibrationWarning,
            stacklevel=5,
        )
    if not isinstance(forecast, Forecast):
        raise TypeError(
            f"{type(model).__name__} predicts {type(forecast).__name__}, not a Forecast: give a "
            "dynamics estimator, or a Pipeline that ends in one."
        )
    return forecast, ds


def residuals_of(forecast: Forecast, truth: TrajectoryDataset, std: Floats) -> Residuals:
    """Residuals of one forecast an episode; episodes and steps that nobody logged are left out.

    Parameters
    ----------
    forecast : Forecast
    truth : TrajectoryDataset
        Its n episodes. A state of the forecast that was never logged has no residuals.
    std : ndarray of shape (n, H, d_s)
        Predicted standard deviations, positive.
    """
    errors = np.full(forecast.mean.shape, np.nan)
    columns, _, _ = shared_states(forecast.state_names, truth)
    errors[..., columns] = forecast.residuals(truth)
    elapsed = forecast.times - forecast.initial_times[:, None]
    logged = ~np.isnan(errors).all(axis=2)
    rows, steps = np.flatnonzero(logged.any(axis=1)), np.flatnonzero(logged.any(axis=0))
    n_steps = steps.max(initial=-1) + 1
    return Residuals(errors[:, :n_steps], std[:, :n_steps], elapsed[:, :n_steps])[rows]
