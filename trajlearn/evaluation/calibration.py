"""Calibration of forecasts by horizon: tidy tables with their statistical error."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import RandomState

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._calibration_table import Bins, CalibrationTable
from trajlearn.evaluation._cells import checked_levels, matched
from trajlearn.evaluation._measures import LEVELS
from trajlearn.trajectories import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["calibration_report", "pit_histogram", "reliability"]


def calibration_report(
    forecast: Forecast,
    truth: TrajectoryDataset,
    *,
    levels: Sequence[float] = (0.5, 0.9),
    bins: Bins = "standard",
    truth_kind: str = "observed",
    n_bootstrap: int = 200,
    confidence: float = 0.95,
    distribution: str = "auto",
    random_state: int | RandomState | None = None,
) -> "pd.DataFrame":
    """How far the uncertainty of a forecast can be trusted, by horizon and state.

    Parameters
    ----------
    forecast : Forecast
        With std, samples or conformal bands.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order. Where they have more states than the
        forecast, those of the same names are compared.
    levels : sequence of float, default=(0.5, 0.9)
        Probabilities that the intervals promise, each between 0 and 1.
    bins : {"standard"}, None or list of (first, last), default="standard"
        Horizons in steps, both included, whose cells count together: the standard bins are 1-5,
        6-25, 26-75, 76-150 and 151 to the end, as far as the forecast goes; None takes every
        horizon by itself.
    truth_kind : {"observed", "true"}, default="observed"
        What the states in `truth` are, for the record: measurements, which include noise, or the
        noise-free states that a simulator knows.
    n_bootstrap : int, default=200
        Resamples of the episodes for `low` and `high`; 0 for none.
    confidence : float, default=0.95
        Probability of the bootstrap interval (percentiles).
    distribution : {"auto", "gaussian", "samples"}, default="auto"
        What `crps`, `nll`, `spread_skill` and `error_std_correlation` take: the Gaussian of mean
        and std, or the samples; "auto" is the Gaussian if there is a std. Coverage, width and
        calibration error are always those of `Forecast.interval`.
    random_state : int, RandomState or None, default=None
        Of the bootstrap.

    Returns
    -------
    DataFrame
        One row a bin (``first``, ``last``), ``state`` ("all" pools the cells of all states),
        ``measure`` and ``level`` (NaN where it has no meaning); ``value``, its bootstrap interval
        ``low``, ``high`` (NaN for fewer than two episodes), ``n_episodes`` with a cell in the bin
        and ``n_diverged`` of them with a diverged one. The measures, over the cells (forecast,
        horizon, state) of the bin, states in training ranges:

        - ``coverage``: share of logged states inside the interval; `level` if calibrated.
        - ``width``: mean width of the interval, the sharpness.
        - ``crps``, ``nll``: means of `crps` and `negative_log_likelihood`; small is good.
        - ``calibration_error``: mean of | coverage - level | over the levels 0.05, 0.10 ... 0.95.
          An average of absolute values, it is above 0 also for a calibrated forecast, and its
          bootstrap interval lies high when episodes are few.
        - ``spread_skill``: root mean variance over root mean squared error; 1 if calibrated,
          below if too sure.
        - ``error_std_correlation``: rank correlation of absolute error and std. It need not be
          near 1: a perfectly calibrated Gaussian is far off at random. A wide bin and the pooled
          states also have the correlation between their horizons and states.
        - ``energy_score``: mean of `energy_scores`, of the joint state ("all"); only with
          samples.

        ``attrs`` holds ``truth`` (`truth_kind`), ``actions``, ``calibrated`` (whether intervals
        are conformal bands), ``distribution``, ``confidence``, ``n_bootstrap`` and ``units``.

    Raises
    ------
    ValueError
        If the forecast has no uncertainty, the episodes are not those that were forecast, or an
        argument is out of its range.

    See Also
    --------
    reliability : coverage at many levels.
    pit_histogram : where the logged states fall in their distributions.
    trajlearn.plotting.plot_coverage : coverage by horizon.

    Notes
    -----
    The steps of an episode depend on one another, so episodes are resampled whole, with all their
    starts. A diverged cell is outside every interval and infinitely wrong: it makes a mean score
    infinite and `spread_skill` 0; the correlation leaves it out. Steps that an episode does not
    have are left out.

    Where the intervals are quantiles of S samples, they end at the outermost ones: no level above
    ``(S - 1) / (S + 1)`` is reached.

    Widths and scores are in units of ``forecast.state_range``: those of two forecasts compare only
    if it is the same. That of a `CalibratedForecaster` includes its calibration episodes; give it
    to the forecast of the model inside: ``raw.state_range = model.state_range_``.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> rng = np.random.default_rng(0)
    >>> ds = TrajectoryDataset.from_arrays(rng.normal(size=(600, 11, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:200])
    >>> forecast = model.predict(ds[200:], return_std=True)
    >>> report = calibration_report(forecast, ds[200:], levels=[0.9], random_state=0)
    >>> pooled = report[report["state"] == "all"]
    >>> pooled[pooled["measure"] == "coverage"][["first", "last", "level", "value"]].round(1)
       first  last  level  value
    0      1     5    0.9    0.9
    14     6    10    0.9    0.9
    """
    levels = checked_levels(levels)
    cells = matched(forecast, truth)
    table = CalibrationTable(
        cells, bins, truth_kind, n_bootstrap, confidence, distribution, random_state
    )
    measures = table.measures
    spread = cells.spread(distribution)
    for name, by_level in (
        ("coverage", measures.coverage(levels)),
        ("width", measures.widths(levels)),
    ):
        table.add(name, by_level, level=levels)
    table.add("crps", [measures.crps()])
    table.add("nll", [measures.nll()])
    table.add("calibration_error", [measures.calibration_error()])
    table.add("spread_skill", [measures.spread_skill(spread)])
    table.add("error_std_correlation", [measures.correlation(spread)])
    if cells.has_samples:
        table.add("energy_score", [measures.energy()])
    return table.frame({"measure": str, "level": float})


def reliability(
    forecast: Forecast,
    truth: TrajectoryDataset,
    *,
    levels: Sequence[float] = LEVELS,
    bins: Bins = "standard",
    truth_kind: str = "observed",
    n_bootstrap: int = 200,
    confidence: float = 0.95,
    random_state: int | RandomState | None = None,
) -> "pd.DataFrame":
    """Coverage of the intervals of many levels: how often what was promised came true.

    Parameters
    ----------
    forecast, truth, bins, truth_kind, n_bootstrap, confidence, random_state
        As in `calibration_report`.
    levels : sequence of float, default=(0.05, 0.1, ..., 0.95)
        Probabilities that the intervals promise.

    Returns
    -------
    DataFrame
        The rows ``coverage`` of `calibration_report`, for `plot_reliability`.

    Raises
    ------
    ValueError
        As in `calibration_report`.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> rng = np.random.default_rng(0)
    >>> ds = TrajectoryDataset.from_arrays(rng.normal(size=(600, 6, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:200])
    >>> forecast = model.predict(ds[200:], return_std=True)
    >>> table = reliability(forecast, ds[200:], levels=[0.2, 0.5, 0.8], random_state=0)
    >>> table[table["state"] == "all"][["level", "value"]].round(1)
       level  value
    0    0.2    0.2
    1    0.5    0.5
    2    0.8    0.8
    """
    levels = checked_levels(levels)
    cells = matched(forecast, truth)
    table = CalibrationTable(cells, bins, truth_kind, n_bootstrap, confidence, "auto", random_state)
    table.add("coverage", table.measures.coverage(levels), level=levels)
    return table.frame({"measure": str, "level": float})


def pit_histogram(
    forecast: Forecast,
    truth: TrajectoryDataset,
    *,
    n_bins: int = 10,
    bins: Bins = "standard",
    distribution: str = "auto",
    truth_kind: str = "observed",
    n_bootstrap: int = 200,
    confidence: float = 0.95,
    random_state: int | RandomState | None = None,
) -> "pd.DataFrame":
    """Histogram of the probability integral transform (`pit_values`) by horizon.

    Parameters
    ----------
    forecast, truth, bins, distribution, truth_kind, n_bootstrap, confidence, random_state
        As in `calibration_report`.
    n_bins : int, default=10
        Bars of the histogram, at least 2.

    Returns
    -------
    DataFrame
        One row a horizon bin (``first``, ``last``), ``state`` and bar from ``left`` to ``right``;
        ``value`` is its density, 1 in every bar if calibrated. ``low``, ``high``, ``n_episodes``,
        ``n_diverged`` and ``attrs`` as in `calibration_report`. Diverged cells are in no bar, so
        that the mean of the densities is the share of the others.

    Raises
    ------
    ValueError
        As in `calibration_report`, or if `n_bins` is below 2.

    Notes
    -----
    Of S samples, a logged state has one of S + 1 slots of equal probability; its weight is spread
    over the bars that its slot overlaps (the nonrandomised PIT [1]_), so that the histogram of a
    calibrated forecast is flat whatever S.

    References
    ----------
    .. [1] Czado, Gneiting, Held: Predictive model assessment for count data. Biometrics 65
       (2009).

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> rng = np.random.default_rng(0)
    >>> ds = TrajectoryDataset.from_arrays(rng.normal(size=(600, 6, 1)))
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds[:200])
    >>> forecast = model.predict(ds[200:], return_std=True)
    >>> table = pit_histogram(forecast, ds[200:], n_bins=2, random_state=0)
    >>> table[table["state"] == "all"][["first", "last", "left", "right", "value"]].round(1)
       first  last  left  right  value
    0      1     5   0.0    0.5    1.0
    1      1     5   0.5    1.0    1.0
    """
    if isinstance(n_bins, bool) or int(n_bins) != n_bins or n_bins < 2:
        raise ValueError(f"n_bins = {n_bins!r} must be a whole number of bars, at least 2.")
    cells = matched(forecast, truth)
    table = CalibrationTable(
        cells, bins, truth_kind, n_bootstrap, confidence, distribution, random_state
    )
    shares = (n_bins * share for share in table.measures.pit_shares(int(n_bins)))
    edges = np.arange(n_bins + 1) / n_bins
    table.add("pit", shares, left=edges[:-1], right=edges[1:])
    return table.frame({"left": float, "right": float})
