"""Forecasts whose uncertainty was checked against held-out episodes, and corrected."""

import warnings
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.frozen import FrozenEstimator
from sklearn.utils import check_random_state
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import HasMethods, Interval, StrOptions, fit_context
from trajlearn.dynamics._episode_arguments import in_groups
from trajlearn.dynamics._forecaster import check_n_samples
from trajlearn.dynamics._meta import ForecasterAround, forecaster_can
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.dynamics._uncertainty.calibration import Residuals, crps_rescaling
from trajlearn.dynamics._uncertainty.conformal import (
    ConformalBands,
    marginal_bands,
    simultaneous_bands,
    steps_of,
)
from trajlearn.dynamics._uncertainty.held_out import fit_and_forecast, residuals_of
from trajlearn.dynamics._uncertainty.residual_paths import ResidualPaths, residual_paths
from trajlearn.dynamics.forecast import Forecast
from trajlearn.dynamics.trajectory import TrajectoryRegressor
from trajlearn.exceptions import CalibrationWarning, HorizonWarning
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._relabeler import generator

__all__ = ["CalibratedForecaster"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# a standard deviation below this share of the training range counts as this much
_LEAST_STD = 1e-9


class CalibratedForecaster(ForecasterAround):
    """Recalibrates the uncertainty of any dynamics estimator on held-out episodes.

    Predicted means stay as they are. What changes is what is said about their errors:

    - `std` becomes ``sqrt((factor * std)^2 + floor^2)``, with a factor and a floor per horizon
      and state that minimise the mean Gaussian CRPS of the calibration episodes. A model without
      a standard deviation gets one.
    - `Forecast.interval` takes its widths from split-conformal bands (`method="conformal"`): of
      all episodes that are exchangeable with those of calibration, at least a share `level` lies
      inside, at each horizon and state (`band="marginal"`), or at all steps and states of an
      episode together (`band="simultaneous"`), whatever the model and the noise.
    - `samples` are whole trajectories: the mean plus the rescaled std times Gaussian noise that
      has the correlation over horizons and states of the calibration residuals, so that sums
      along a trajectory, such as rewards, have the right spread.

    The unit of calibration is the episode: one start in each, never several, since the errors of
    one episode go together. Bands at a level of 90 % need at least 9 calibration episodes that
    reach a horizon, at 95 % 19, and simultaneous ones twice as many; with fewer they are infinite,
    and `Forecast.interval` warns.

    Parameters
    ----------
    estimator : dynamics estimator, Pipeline that ends in one, or None, default=None
        None is `TrajectoryRegressor()`. Only its `predict(episodes, ...)` is used. One that is
        fitted, in a `FrozenEstimator`, is calibrated on all episodes given to `fit`: they should
        not be those it was fitted on.
    method : {"conformal", "variance"}, default="conformal"
        "variance" rescales the standard deviation only; intervals are then those of the samples
        or Gaussian, and nothing is guaranteed.
    band : {"marginal", "simultaneous"}, default="marginal"
        Simultaneous bands are wider: over T steps and d_s states about as wide as marginal ones
        of a level nearer to 1. Half of the calibration episodes, drawn at random, go into their
        shape, the other half into their size.
    cv : float, int, splitter or iterable of (train, test), default=0.2
        A float: that share of whole episodes (of groups, where there are) is held out, and the
        estimator fitted on the rest; then the coverage is guaranteed for episodes exchangeable
        with those held out, which those of new groups are not if groups have several episodes.
        Otherwise each episode is forecast by an estimator fitted on the other folds, and the
        final one on all: no episode is lost and the coverage is good in practice, but not
        guaranteed.
    start : int or "random", default=0
        Start of the forecast of each calibration episode; "random" draws one for each. Coverage
        is for forecasts that start alike.
    error_score : float, default=-1e12
        Score of a diverged episode.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_ : estimator
        The fitted one.
    rescaling_ : Rescaling
        Its ``factor`` (H, d_s) and ``floor`` (H, d_s) at each step. For a model without a standard
        deviation, the factor is the standard deviation itself in training ranges.
    bands_ : ConformalBands or None
        Scores of the calibration episodes.
    calibration_ids_ : ndarray of shape (n_calibration,)
        Ids of the episodes that calibrated (``np.isin(ds.ids, model.calibration_ids_)``).
    n_calibration_ : ndarray of shape (H,)
        Calibration episodes that reach each step.
    has_std_ : bool
        Whether the estimator gives a standard deviation.
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest states of the episodes given to `fit`, those of calibration included;
        of a frozen estimator those that it was fitted on.
    state_names_ : tuple of str

    Notes
    -----
    Calibration says how wrong the forecasts were, not why. If new episodes differ from those of
    calibration (other controllers, another battery), nothing is guaranteed; nor for forecasts by
    other actions than those of calibration, of which a warning speaks. A diverged forecast counts
    as an infinite error in the bands, and is left out of `rescaling_` and of the samples' noise.
    Beyond the last step that calibration episodes reach, bands are infinite, and `std` keeps the
    last factor and floor with a `HorizonWarning`. States that were never logged, as velocities
    estimated by a smoother, keep their `std`, and their bands are infinite.

    `trajlearn.dynamics._uncertainty.conformal` says how the bands are made, with references.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import CalibratedForecaster, TrajectoryDataset, TrajectoryRegressor
    >>> walks = np.cumsum(np.random.default_rng(0).normal(size=(100, 9, 1)), axis=1)
    >>> ds = TrajectoryDataset.from_arrays(walks)
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0)
    >>> model = CalibratedForecaster(model, cv=0.5, random_state=0).fit(ds[:80])
    >>> forecast = model.predict(ds[80:], return_std=True)
    >>> forecast
    Forecast(n=20, H=8, d_s=1, std, bands)
    >>> lower, upper = forecast.interval(0.9)
    >>> bool(np.mean((lower <= walks[80:, 1:]) & (walks[80:, 1:] <= upper)) > 0.8)
    True
    """

    bands_: ConformalBands | None

    _forecasts_by = "estimator"
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "estimator": [HasMethods(["fit", "predict"]), None],
        "method": [StrOptions({"conformal", "variance"})],
        "band": [StrOptions({"marginal", "simultaneous"})],
        "cv": [Interval(Real, 0, 1, closed="neither"), "cv_object"],
        "start": [Interval(Integral, 0, None, closed="left"), StrOptions({"random"})],
        "error_score": [Interval(Real, None, 0, closed="both")],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        method: str = "conformal",
        band: str = "marginal",
        cv: Any = 0.2,
        start: int | str = 0,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.method = method
        self.band = band
        self.cv = cv
        self.start = start
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {"estimator": TrajectoryRegressor()}

    def __sklearn_is_fitted__(self) -> bool:
        # what is set last: an estimator without its calibration does not count
        return hasattr(self, "bands_")

    # -- fitting --------------------------------------------------------------------------

    @fit_context(prefer_skip_nested_validation=False)
    def fit(self, X: Any, y: None = None, *, groups: ArrayLike | None = None) -> Self:
        """Fit the estimator on some episodes, and calibrate it on others.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Must be omitted.
        groups : array-like of shape (n,), optional
            Labels of episodes that are held out together. The default is ``ds.group``, else the
            episode.

        Returns
        -------
        self

        Warns
        -----
        CalibrationWarning
            If held-out episodes end before `start`, and so do not calibrate.

        Raises
        ------
        TypeError
            If `X` is rows, or the estimator predicts no `Forecast`.
        ValueError
            If there are too few episodes or groups, or a splitter holds one out twice.
        """
        ds = in_groups(self._episodes(X, y), groups)
        # if this fit fails, the calibration of an earlier one must not be taken for its own
        if hasattr(self, "bands_"):
            del self.bands_
        seed = check_random_state(self.random_state).randint(2**31, size=4)
        rng = np.random.default_rng(seed)
        self.estimator_, forecast, truth = fit_and_forecast(
            self._given()["estimator"], ds, cv=self.cv, start=self.start, rng=rng
        )
        self.calibration_ids_ = truth.ids
        self.has_std_ = forecast.std is not None
        self.state_names_ = forecast.state_names
        self.state_range_ = self._range(forecast, ds)
        residuals = residuals_of(forecast, truth, self._raw_std(forecast))
        if len(residuals) < 2:
            raise ValueError(
                f"only {len(residuals)} episode is left to calibrate on (cv={self.cv!r}, "
                f"start={self.start!r}, {len(ds)} episodes): log more, or hold more out."
            )
        self.n_calibration_ = (~np.isnan(residuals.errors)).any(axis=2).sum(axis=0)
        self.rescaling_ = crps_rescaling(residuals)
        self._actions = forecast.actions
        self._elapsed = np.maximum.accumulate(np.nanmedian(residuals.elapsed, axis=0))
        self._paths: ResidualPaths = residual_paths(residuals.rescaled(self.rescaling_))
        self.bands_ = None if self.method == "variance" else self._bands(residuals, rng)
        return self

    def _range(self, forecast: Forecast, ds: TrajectoryDataset) -> Floats:
        """Range of all episodes of training, of those held out for calibration, too."""
        if isinstance(self.estimator_, FrozenEstimator):
            return forecast.state_range
        found = forecast.state_range.copy()
        columns, _, logged = shared_states(forecast.state_names, ds)
        found[:, columns] = logged.min(axis=0), logged.max(axis=0)
        return found

    def _raw_std(self, forecast: Forecast) -> Floats:
        """The model's standard deviation (n, H, d_s), or the training ranges of a model without.

        inf where the forecast diverged, NaN in the padding.
        """
        low, high = self.state_range_
        width = np.where(high > low, high - low, 1.0)
        if not self.has_std_:
            return np.where(np.isfinite(forecast.mean), width, forecast.mean)
        assert forecast.std is not None  # asked for
        return np.maximum(forecast.std, _LEAST_STD * width)

    def _bands(self, residuals: Residuals, rng: np.random.Generator) -> ConformalBands:
        if self.band == "marginal":
            return marginal_bands(residuals, self._elapsed)
        # a modulation learned from the scores themselves would favour them over new ones
        order = rng.permutation(len(residuals))
        shape, size = np.split(order, [len(order) // 2])
        modulation = crps_rescaling(residuals[shape])
        return simultaneous_bands(residuals[size], modulation, self._elapsed)

    # -- prediction -----------------------------------------------------------------------

    def predict(
        self,
        X: Any,
        return_std: bool = False,
        *,
        n_samples: int | None = None,
        random_state: Any = None,
        **settings: Any,
    ) -> Forecast:
        """Forecast episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        return_std : bool, default=False
            Also give `std`, and `bands` if the method is "conformal".
        n_samples : int or None, default=None
            Also draw that many whole trajectories; `std` and `bands` come with them.
        random_state : int, RandomState or None, default=None
        **settings
            Start, horizon, actions and policy, as in `forecast` of the estimator.

        Returns
        -------
        Forecast

        Warns
        -----
        HorizonWarning
            If uncertainty is asked for beyond the horizons of calibration.
        CalibrationWarning
            If actions come from elsewhere than in calibration.
        """
        check_is_fitted(self)
        check_n_samples(n_samples)
        uncertain = return_std or bool(n_samples)
        asked = uncertain and self.has_std_
        raw = super().predict(X, asked, random_state=random_state, **settings)
        return self._calibrated(raw, n_samples, random_state) if uncertain else raw

    @available_if(forecaster_can("predict_trajectory"))
    def predict_trajectory(
        self,
        initial_states: ArrayLike,
        *,
        horizons: ArrayLike,
        return_std: bool = False,
        n_samples: int | None = None,
        random_state: Any = None,
        **signals: Any,
    ) -> Forecast:
        """Predict from states and known signals alone, without a dataset: for planning.

        Parameters
        ----------
        initial_states : array-like of shape (n, d_s) or (d_s,)
        horizons : array-like of shape (H,)
            Times after the start. Each is calibrated as the next step at or after it.
        return_std, n_samples, random_state
            As in `predict`.
        **signals
            As in `predict_trajectory` of the estimator.

        Returns
        -------
        Forecast
        """
        check_is_fitted(self)
        check_n_samples(n_samples)
        uncertain = return_std or bool(n_samples)
        raw = super().predict_trajectory(
            initial_states,
            horizons=horizons,
            return_std=uncertain and self.has_std_,
            random_state=random_state,
            **signals,
        )
        return self._calibrated(raw, n_samples, random_state) if uncertain else raw

    def _calibrated(self, raw: Forecast, n_samples: int | None, random_state: Any) -> Forecast:
        """A forecast of the estimator with rescaled std, samples and bands."""
        steps = steps_of(raw.horizons, self._elapsed)
        self._warn_uncalibrated(raw, steps)
        raw_std = self._raw_std(raw)
        std = self.rescaling_.of(raw_std, steps)
        samples = None
        if n_samples:
            rng = np.random.default_rng() if random_state is None else generator(random_state)
            # a stream of its own: the estimator may have used the same seed
            noise = self._paths.draw(rng.spawn(1)[0], (n_samples, len(raw)), steps)
            with np.errstate(invalid="ignore"):
                samples = np.where(np.isfinite(raw.mean), raw.mean + std * noise, raw.mean)
        bands = None if self.bands_ is None else np.full(len(raw), self.bands_, dtype=object)
        return raw._replace(std=std, raw_std=raw_std, samples=samples, bands=bands)

    def _warn_uncalibrated(self, raw: Forecast, steps: Ints) -> None:
        if raw.actions != self._actions:
            warnings.warn(
                f"calibrated on forecasts with actions={self._actions!r}, but this one has "
                f"actions={raw.actions!r}: its uncertainty may be wrong.",
                CalibrationWarning,
                stacklevel=4,
            )
        reach = self._paths.reach
        if steps.max() >= reach:
            warnings.warn(
                f"too few calibration episodes go beyond step {reach}; the std of later steps is "
                "rescaled as that of the last one.",
                HorizonWarning,
                stacklevel=4,
            )
