"""What a dynamics estimator predicts: trajectories with their uncertainty."""

from collections.abc import Callable
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from trajlearn.dynamics._joined_forecasts import PER_FORECAST, joined
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.dynamics._uncertainty.conformal import half_widths
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Forecast", "shared_states"]

Floats = NDArray[np.float64]

# fields with one entry a forecast that are None where there is none
_PERHAPS = ("std", "raw_std", "episode", "bands")


class Forecast:
    """Predicted trajectories of n episodes over H steps.

    What `forecast` and `predict` of a dynamics estimator return; hardly ever built by hand.
    Indexing by episode gives a forecast again and `numpy.concatenate` joins forecasts of
    different lengths, so that `cross_val_predict` works; ``np.asarray(forecast)`` is `mean`.

    Parameters
    ----------
    mean : ndarray of shape (n, H, d_s)
        Predicted states, from the first step after the start; NaN beyond `lengths` (padding),
        +inf from `diverged_at` on.
    times : ndarray of shape (n, H)
        Time of each predicted state.
    horizons : ndarray of shape (H,)
        Steps after the start, or, from `predict_trajectory`, time after the start.
    lengths : ndarray of shape (n,)
        Predicted steps of each episode.
    initial_states : ndarray of shape (n, d_s)
        State that each forecast begins at.
    initial_times : ndarray of shape (n,)
        Its time.
    start : ndarray of shape (n,)
        Its index in the episode.
    diverged_at : ndarray of shape (n,)
        First step at which a forecast is non-finite or beyond 1e6 training ranges; 0 if none.
    state_range : ndarray of shape (2, d_s)
        Least and greatest training states, which errors are normalised by.
    state_names : tuple of str
    actions : {"none", "logged", "policy"}, default="none"
        Where the actions of a roll-out came from.
    std : ndarray of shape (n, H, d_s) or None, default=None
        Total predictive standard deviation.
    samples : ndarray of shape (n_samples, n, H, d_s) or None, default=None
        Whole trajectories.
    episode : ndarray of shape (n,) or None, default=None
        Episode of each forecast, where episodes have several starts; otherwise forecast i
        belongs to episode i.
    bands : ndarray of shape (n,) of ConformalBands or None, default=None
        Calibration of each forecast, of which `interval` takes its widths
        (`CalibratedForecaster`); forecasts of one calibration share it. Needs `raw_std`.
    raw_std : ndarray of shape (n, H, d_s) or None, default=None
        Standard deviation before calibration, which `bands` multiply.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> states = [np.linspace(0, slope, 5)[:, None] for slope in (1.0, 2.0)]
    >>> ds = TrajectoryDataset.from_arrays(states, params=[[1.0], [2.0]])
    >>> forecast = TrajectoryRegressor(LinearRegression(), random_state=0).fit(ds).predict(ds)
    >>> forecast
    Forecast(n=2, H=4, d_s=1)
    >>> forecast.mean.shape, forecast[1:].mean.shape, forecast.at([2, 4]).horizons
    ((2, 4, 1), (1, 4, 1), array([2, 4]))
    """

    def __init__(
        self,
        mean: Floats,
        *,
        times: Floats,
        horizons: NDArray[Any],
        lengths: NDArray[np.intp],
        initial_states: Floats,
        initial_times: Floats,
        start: NDArray[np.intp],
        diverged_at: NDArray[np.intp],
        state_range: Floats,
        state_names: tuple[str, ...],
        actions: str = "none",
        std: Floats | None = None,
        samples: Floats | None = None,
        episode: NDArray[np.intp] | None = None,
        bands: NDArray[np.object_] | None = None,
        raw_std: Floats | None = None,
    ) -> None:
        if bands is not None and raw_std is None:
            raise ValueError("bands need raw_std, the standard deviation that they multiply.")
        self.mean, self.std, self.samples = mean, std, samples
        self.bands, self.raw_std = bands, raw_std
        self.times, self.horizons, self.lengths = times, horizons, lengths
        self.initial_states, self.initial_times = initial_states, initial_times
        self.start, self.episode, self.diverged_at = start, episode, diverged_at
        self.state_range, self.state_names, self.actions = state_range, state_names, actions

    # -- container ------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def shape(self) -> tuple[int]:
        """``(n,)``: the sample is the episode."""
        return (len(self),)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.mean, dtype=dtype, copy=copy)

    def __array_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Any:
        if func is np.concatenate and len(args) == 1 and not kwargs.get("axis"):
            return joined(list(args[0]))
        plain = {name: _without_forecasts(value) for name, value in kwargs.items()}
        return func(*_without_forecasts(args), **plain)

    def __getitem__(self, key: Any) -> "Forecast":
        if isinstance(key, tuple):
            # scikit-learn indexes samples with (indices, ...)
            key = key[0]
        index = np.atleast_1d(np.arange(len(self))[key])
        chosen: dict[str, Any] = {name: getattr(self, name)[index] for name in PER_FORECAST}
        for name in _PERHAPS:
            value = getattr(self, name)
            chosen[name] = None if value is None else value[index]
        return self._replace(
            mean=self.mean[index],
            samples=None if self.samples is None else self.samples[:, index],
            **chosen,
        )

    def _replace(self, **changes: Any) -> "Forecast":
        return Forecast(**(vars(self) | changes))

    def __repr__(self) -> str:
        parts = [f"n={len(self)}", f"H={self.mean.shape[1]}", f"d_s={self.mean.shape[2]}"]
        if self.std is not None:
            parts.append("std")
        if self.samples is not None:
            parts.append(f"samples={len(self.samples)}")
        if self.bands is not None:
            parts.append("bands")
        if self.actions != "none":
            parts.append(f"actions={self.actions!r}")
        if self.diverged_at.any():
            parts.append(f"diverged={int((self.diverged_at > 0).sum())}")
        return f"Forecast({', '.join(parts)})"

    # -- use ------------------------------------------------------------------------------

    def at(self, horizons: ArrayLike) -> "Forecast":
        """Only the given entries of `horizons`.

        Parameters
        ----------
        horizons : array-like
            Increasing; each must have been predicted.

        Returns
        -------
        Forecast

        Raises
        ------
        ValueError
            If a horizon was not predicted, or they are not in order.
        """
        wanted = np.atleast_1d(np.asarray(horizons))
        if (np.diff(wanted) <= 0).any():
            raise ValueError("horizons must increase strictly.")
        columns = np.searchsorted(self.horizons, wanted)
        clipped = np.minimum(columns, len(self.horizons) - 1)
        missing = wanted[self.horizons[clipped] != wanted]
        if len(missing):
            raise ValueError(
                f"horizons {missing.tolist()} were not predicted; the forecast has "
                f"{self.horizons[0]}..{self.horizons[-1]}."
            )
        steps = columns + 1
        diverged = np.searchsorted(steps, self.diverged_at) + 1
        lengths = np.searchsorted(steps, self.lengths, side="right")
        gone = (self.diverged_at > 0) & (diverged <= len(steps))
        return self._replace(
            mean=self.mean[:, columns],
            std=None if self.std is None else self.std[:, columns],
            raw_std=None if self.raw_std is None else self.raw_std[:, columns],
            samples=None if self.samples is None else self.samples[:, :, columns],
            times=self.times[:, columns],
            horizons=self.horizons[columns],
            lengths=lengths,
            diverged_at=np.where(gone, diverged, 0),
        )

    def interval(self, level: float = 0.9) -> tuple[Floats, Floats]:
        """Central interval of each state at each step.

        Parameters
        ----------
        level : float, default=0.9
            Probability inside, between 0 and 1.

        Returns
        -------
        lower, upper : ndarray of shape (n, H, d_s)
            Of the conformal bands if there are some; else quantiles of the samples, if there
            are some; else Gaussian. S samples reach no level above ``(S - 1) / (S + 1)``; beyond,
            the interval is that of the outermost two.

        Warns
        -----
        CalibrationWarning
            If too few episodes were calibrated on for bands of this level, which are infinite.

        Raises
        ------
        ValueError
            If the forecast has neither std nor samples.
        """
        if not 0 < level < 1:
            raise ValueError(f"level = {level} must lie between 0 and 1.")
        if self.bands is not None:
            assert self.raw_std is not None  # __init__ has checked
            width = half_widths(self.bands, level, self.raw_std, self.horizons, self.lengths)
            with np.errstate(invalid="ignore"):
                return self.mean - width, self.mean + width
        if self.samples is not None:
            tail = (1 - level) / 2
            # of S + 1 slots between S samples a truth of the same kind is in each equally often
            with np.errstate(invalid="ignore"):
                lower, upper = np.quantile(self.samples, [tail, 1 - tail], axis=0, method="weibull")
            # between two samples that have diverged nothing can be interpolated
            gone = np.isinf(self.samples).any(axis=0)
            return (
                np.where(gone & np.isnan(lower), -np.inf, lower),
                np.where(gone & np.isnan(upper), np.inf, upper),
            )
        if self.std is None:
            raise ValueError(
                "the forecast has no uncertainty: ask for return_std=True or n_samples=."
            )
        width = NormalDist().inv_cdf(0.5 + level / 2) * self.std
        return self.mean - width, self.mean + width

    def residuals(self, truth: TrajectoryDataset) -> Floats:
        """Logged states minus predicted ones (n, H, d_s), in their own units.

        NaN where `truth` or the forecast has no such step; +inf from the divergence on. A
        dataset whose states are a transformer's estimates is compared by its `observed`, the
        states as logged. Of a forecast that has states `truth` lacks (``d_<name>``, estimated
        velocities) or lacks states that it has, those of the same names are compared.

        Parameters
        ----------
        truth : TrajectoryDataset
            Episodes in the order of the forecasts (by `episode`, where given).

        Returns
        -------
        ndarray of shape (n, H, d_s)
            d_s: the states that both have, in the order of the forecast.

        Raises
        ------
        ValueError
            If the episodes do not match the forecasts, or the horizons are times, not steps.
        """
        if not np.issubdtype(np.asarray(self.horizons).dtype, np.integer):
            raise ValueError(
                "this forecast is over times, not steps (it comes from predict_trajectory); "
                "errors against logged episodes need forecast(ds) or predict(ds)."
            )
        if self.episode is None and len(truth) != len(self):
            raise ValueError(f"{len(self)} forecasts, but {len(truth)} episodes to compare with.")
        columns, _, logged = shared_states(self.state_names, truth)
        episode = np.arange(len(self)) if self.episode is None else self.episode
        steps = self.start[:, None] + self.horizons[None, :]
        known = steps <= truth.lengths[episode][:, None]
        known &= np.arange(len(self.horizons)) < self.lengths[:, None]
        rows = truth.offsets[:-1][episode][:, None] + np.where(known, steps, 0)
        residuals = logged[rows] - self.mean[..., columns]
        diverged = (self.diverged_at > 0)[:, None] & (
            np.arange(1, len(self.horizons) + 1) >= self.diverged_at[:, None]
        )
        residuals[diverged] = np.inf
        residuals[~known] = np.nan
        return residuals

    def squared_errors(self, truth: TrajectoryDataset) -> Floats:
        """Squared error of each state in units of its training range (n, H, d_s).

        Parameters
        ----------
        truth : TrajectoryDataset
            As in `residuals`.

        Returns
        -------
        ndarray of shape (n, H, d_s)
            NaN where there is nothing to compare with; +inf from the divergence on.

        Raises
        ------
        ValueError
            As in `residuals`.
        """
        residuals = self.residuals(truth)
        columns, _, _ = shared_states(self.state_names, truth)
        low, high = self.state_range[:, columns]
        with np.errstate(over="ignore"):
            return (residuals / np.where(high > low, high - low, 1.0)) ** 2

    def to_dataset(self) -> TrajectoryDataset:
        """Mean trajectories as episodes, the initial state first; cut where they diverge.

        Returns
        -------
        TrajectoryDataset

        Raises
        ------
        ValueError
            If a forecast has no finite step.
        """
        steps = np.where(self.diverged_at > 0, self.diverged_at - 1, self.lengths)
        if (steps < 1).any():
            i = int(np.flatnonzero(steps < 1)[0])
            raise ValueError(f"forecast {i} has no finite step; leave it out: forecast[mask].")
        return TrajectoryDataset.from_arrays(
            [
                np.concatenate([s0[None], mean[:k]])
                for s0, mean, k in zip(self.initial_states, self.mean, steps)
            ],
            times=[
                np.concatenate([[t0], times[:k]])
                for t0, times, k in zip(self.initial_times, self.times, steps)
            ],
            state_names=self.state_names,
        )

    def to_frame(self) -> "pd.DataFrame":
        """Long table, one row a forecast and horizon.

        Returns
        -------
        DataFrame
            Columns ``episode``, ``start``, ``horizon``, ``time``, then the mean of each state by
            its name, and its standard deviation as ``<name>_std`` where there is one.
        """
        import pandas as pd

        n, n_horizons, _ = self.mean.shape
        kept = (np.arange(1, n_horizons + 1) <= self.lengths[:, None]).ravel()
        columns = {
            "episode": np.repeat(
                np.arange(n) if self.episode is None else self.episode, n_horizons
            ),
            "start": np.repeat(self.start, n_horizons),
            "horizon": np.tile(self.horizons, n),
            "time": self.times.ravel(),
        }
        for j, name in enumerate(self.state_names):
            columns[name] = self.mean[..., j].ravel()
            if self.std is not None:
                columns[f"{name}_std"] = self.std[..., j].ravel()
        return pd.DataFrame(columns)[kept].reset_index(drop=True)


def _without_forecasts(value: Any) -> Any:
    """Replace forecasts by their means, also inside lists and tuples."""
    if isinstance(value, (list, tuple)):
        return type(value)(_without_forecasts(item) for item in value)
    return np.asarray(value) if isinstance(value, Forecast) else value
