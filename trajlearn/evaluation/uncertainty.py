"""How good the uncertainty of a forecast is, cell by cell: (forecast, horizon, state)."""

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._cells import checked_levels, matched
from trajlearn.trajectories import TrajectoryDataset

__all__ = [
    "crps",
    "energy_scores",
    "interval_hits",
    "interval_widths",
    "negative_log_likelihood",
    "pit_values",
]

Floats = NDArray[np.float64]


def interval_hits(forecast: Forecast, truth: TrajectoryDataset, level: float = 0.9) -> Floats:
    """Whether each logged state lies inside its central interval.

    Parameters
    ----------
    forecast : Forecast
        With std, samples or conformal bands.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order. Where they have more states than the
        forecast, those of the same names are compared.
    level : float, default=0.9
        Probability that the interval promises, between 0 and 1.

    Returns
    -------
    ndarray of shape (n, H, d_s)
        1 inside (bounds included) or 0 outside `Forecast.interval`; NaN where there is no such
        step. From a divergence on nothing is inside. Where a band or a std is infinite, everything
        is, and the width says so.

    Raises
    ------
    ValueError
        If the forecast has no uncertainty, the episodes are not those that were forecast, or
        `level` is not between 0 and 1.

    See Also
    --------
    calibration_report : these scores by horizon, with their statistical error.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> hits = interval_hits(model.predict(ds, return_std=True), ds, level=0.95)
    >>> hits.shape, bool(hits.mean() > 0.8)
    ((9, 6, 1), True)
    """
    return next(matched(forecast, truth).hits(checked_levels(level)))


def interval_widths(forecast: Forecast, truth: TrajectoryDataset, level: float = 0.9) -> Floats:
    """Width of the central interval of each state: the sharpness.

    Parameters
    ----------
    forecast, truth, level
        As in `interval_hits`.

    Returns
    -------
    ndarray of shape (n, H, d_s)
        In training ranges of each state; NaN where there is no such step, +inf from a divergence
        on.

    Raises
    ------
    ValueError
        As in `interval_hits`.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> forecast = model.predict(ds, return_std=True)
    >>> narrow, wide = (interval_widths(forecast, ds, level) for level in (0.5, 0.95))
    >>> bool((narrow < wide).all())
    True
    """
    return next(matched(forecast, truth).widths(checked_levels(level)))


def pit_values(
    forecast: Forecast, truth: TrajectoryDataset, *, distribution: str = "auto"
) -> Floats:
    """Probability integral transform: predicted probability below each logged state.

    Uniform between 0 and 1 if the forecast is calibrated; heaped at both ends if it is too sure
    of itself, in the middle if not sure enough, at one end if it is biased.

    Parameters
    ----------
    forecast, truth
        As in `interval_hits`.
    distribution : {"auto", "gaussian", "samples"}, default="auto"
        What is scored: the Gaussian of `mean` and `std`, or the samples; "auto" is the Gaussian
        if the forecast has a std, else the samples.

    Returns
    -------
    ndarray of shape (n, H, d_s)
        NaN where there is no such step, and from a divergence on. S samples leave S + 1 slots for
        a logged state; its PIT is the middle of its own.

    Raises
    ------
    ValueError
        If the forecast has no such distribution, or the episodes are not those that were
        forecast.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> pit = pit_values(model.predict(ds, return_std=True), ds)
    >>> bool((pit[0] < pit[8]).all())  # the last episode climbs higher than the first
    True
    """
    return matched(forecast, truth).pit(distribution)


def crps(forecast: Forecast, truth: TrajectoryDataset, *, distribution: str = "auto") -> Floats:
    """Continuous ranked probability score: error of a distribution, small is good.

    The absolute error where the distribution is a point; otherwise [1]_ it rewards a distribution
    that is both sharp and right. Of samples it is the fair estimate, whose mean does not depend
    on their number (it may be below 0 for a few cells).

    Parameters
    ----------
    forecast, truth, distribution
        As in `pit_values`.

    Returns
    -------
    ndarray of shape (n, H, d_s)
        In training ranges of each state; NaN where there is no such step, +inf from a divergence
        on and where a std or a sample is infinite.

    Raises
    ------
    ValueError
        As in `pit_values`.

    References
    ----------
    .. [1] Gneiting, Raftery: Strictly proper scoring rules, prediction, and estimation. Journal
       of the American Statistical Association 102 (2007).

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> forecast = model.predict(ds, return_std=True, n_samples=500, random_state=0)
    >>> scores = [crps(forecast, ds, distribution=of).mean() for of in ("gaussian", "samples")]
    >>> bool(np.isclose(*scores, rtol=0.05))
    True
    """
    return matched(forecast, truth).crps(distribution)


def negative_log_likelihood(
    forecast: Forecast, truth: TrajectoryDataset, *, distribution: str = "auto"
) -> Floats:
    """Negative logarithm of the predicted density at each logged state.

    Parameters
    ----------
    forecast, truth, distribution
        As in `pit_values`; of samples, the Gaussian with their mean and standard deviation.

    Returns
    -------
    ndarray of shape (n, H, d_s)
        Natural logarithm; the density is that of the state in training ranges, so that it is
        below 0 where the std is a small part of the range. NaN where there is no such step, +inf
        from a divergence on and where a std or a sample is infinite. A std below 1e-6 ranges
        counts as 1e-6: a point has no density.

    Raises
    ------
    ValueError
        As in `pit_values`.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> negative_log_likelihood(model.predict(ds, return_std=True), ds).shape
    (9, 6, 1)
    """
    return matched(forecast, truth).nll(distribution)


def energy_scores(forecast: Forecast, truth: TrajectoryDataset) -> Floats:
    """Energy score: the CRPS of the joint state, of samples.

    ``E |X - y| - E |X - X'| / 2`` with Euclidean distances of states in training ranges; the
    fair estimate, as in `crps`. It sees correlations between states that scores of single states
    do not.

    Parameters
    ----------
    forecast : Forecast
        With at least two samples.
    truth : TrajectoryDataset or list of Trajectory
        As in `interval_hits`.

    Returns
    -------
    ndarray of shape (n, H)
        NaN where there is no such step, +inf from a divergence on and where a sample is infinite.

    Raises
    ------
    ValueError
        If the forecast has no samples, or the episodes are not those that were forecast.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> forecast = model.predict(ds, n_samples=20, random_state=0)
    >>> bool(np.allclose(energy_scores(forecast, ds), crps(forecast, ds)[..., 0]))  # one state
    True
    """
    return matched(forecast, truth).energy()
