"""How far ahead forecasts may be trusted, with a guarantee that holds for small test sets."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, log
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from trajlearn.dynamics import Forecast
from trajlearn.dynamics.forecast import shared_states
from trajlearn.evaluation._horizons import predicted_states, whole_steps
from trajlearn.evaluation._matching import check_same_times, episode_of, with_states_of
from trajlearn.evaluation._statistics import quantile
from trajlearn.trajectories import TrajectoryDataset, as_dataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["TrustHorizon", "trust_horizon"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Tolerance = float | Mapping[str, float]


@dataclass(frozen=True, eq=False, repr=False)
class TrustHorizon:
    """How far ahead a forecaster may be trusted; made by `trust_horizon`.

    Attributes
    ----------
    horizon : int
        Steps; 0 if not even the first step may be trusted.
    time : float
        Median time that `horizon` steps take, in the unit of the dataset's times.
    limit : {"tolerance", "episodes", "forecast"}
        Why no further: too many episodes leave the tolerance, too few reach the next step to
        know, or the forecasts end.
    share : float
    confidence : float
    tolerance : float or dict of str to float
    n_episodes : int
        Episodes that were forecast.
    table : DataFrame
        Index ``horizon``; columns ``time`` (median over forecasts), ``n_episodes`` (that count),
        ``n_within`` (of them, within the tolerance so far), ``share_within`` and ``lower``, the
        lower confidence bound of the share at this horizon.
    """

    horizon: int
    time: float
    limit: str
    share: float
    confidence: float
    tolerance: Tolerance
    n_episodes: int
    table: "pd.DataFrame"

    def __repr__(self) -> str:
        return (
            f"TrustHorizon(horizon={self.horizon}, time={self.time:.6g}, limit={self.limit!r}, "
            f"share={self.share:g}, confidence={self.confidence:g}, "
            f"tolerance={self.tolerance!r}, n_episodes={self.n_episodes})"
        )


def trust_horizon(
    forecaster: Any,
    dataset: TrajectoryDataset,
    tolerance: Tolerance,
    *,
    share: float = 0.9,
    confidence: float = 0.95,
    horizon: int | None = None,
    start: ArrayLike | None = None,
) -> TrustHorizon:
    """Greatest horizon up to which forecasts of most new episodes stay within a tolerance.

    An episode is within the tolerance at horizon h if its error never exceeds it up to h. The
    trust horizon is the greatest h such that, with probability `confidence` over the draw of the
    test episodes, at least `share` of all episodes that last h steps are within it.

    Parameters
    ----------
    forecaster : dynamics estimator, Pipeline or Forecast
        Fitted, on other episodes; or its forecast of `dataset`.
    dataset : TrajectoryDataset or list of Trajectory
        Test episodes: independent draws of what is to be forecast.
    tolerance : float or mapping from state name to float
        A number is the greatest root mean square over the states of errors in training ranges,
        the root of `horizon_errors`. A mapping gives the greatest absolute error of each named
        state in its own unit; the other states may err.
    share : float, default=0.9
        Share of new episodes, between 0 and 1.
    confidence : float, default=0.95
        Probability that the statement is true, between 0 and 1.
    horizon : int, optional
        Steps to look ahead at most; default: to the end of the longest episode.
    start : int, array-like or list of arrays, optional
        Where forecasts begin, as in ``predict(ds, start=...)``.

    Returns
    -------
    TrustHorizon

    Raises
    ------
    ValueError
        If there are too few episodes to be so confident of any horizon (29 are needed for the
        default settings, all of them within the tolerance), a setting is out of its range, a
        state of `tolerance` is unknown, or a ready forecast leaves out steps.
    TypeError
        If the forecaster does not predict states.

    See Also
    --------
    horizon_errors : the errors themselves.

    Notes
    -----
    The lower bound of the share at a horizon is Clopper and Pearson's exact one-sided bound. The
    horizons 1, 2, ... are tested in this order up to the first whose bound is below `share`; a
    sequence of tests fixed beforehand needs no correction for their number [1]_.

    A forecast that has diverged has left the tolerance. An episode that has left it once counts
    against all later horizons, also beyond its end; one that ends within it counts up to its end
    only. That can only lower the bound compared with leaving out all episodes shorter than h,
    for which it is exact, whatever the reason for their ends.

    Of an episode with several starts all forecasts have to stay within the tolerance, each to its
    own end or to h; the episode lasts as long as its longest forecast. Episodes that resemble one
    another (those of one `group`) are not independent draws: then the statement holds for new
    episodes of the same groups only.

    References
    ----------
    .. [1] W. Maurer, L. A. Hothorn and W. Lehmacher, "Multiple comparisons in drug clinical
       trials and preclinical assays: a-priori ordered hypotheses", 1995.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import HoldForecaster, TrajectoryDataset
    >>> walks = np.random.default_rng(0).normal(size=(160, 31, 1)).cumsum(axis=1)
    >>> ds = TrajectoryDataset.from_arrays(list(walks), dt=0.5, state_names=["x"])
    >>> model = HoldForecaster().fit(ds[:80])
    >>> trust = trust_horizon(model, ds[80:], {"x": 6.0})
    >>> trust.horizon, trust.time, trust.limit
    (7, 3.5, 'tolerance')
    >>> trust.table.loc[7:8, ["n_episodes", "n_within", "lower"]].round(3)
             n_episodes  n_within  lower
    horizon
    7                80        77  0.906
    8                80        75  0.873
    """
    _check_settings(tolerance, share, confidence)
    longest = None if horizon is None else int(whole_steps([horizon], "horizon")[0])
    ds = as_dataset(dataset)
    forecast = _forecast(forecaster, ds, longest, start)
    worst = _excess(forecast, ds, tolerance)
    if longest is not None:
        worst = worst[:, :longest]
    failed_at, reach = _by_episode(worst, episode_of(forecast))
    _check_enough(len(reach), share, confidence)
    table = _table(failed_at, reach, worst.shape[1], confidence)
    elapsed = forecast.times[:, : len(table)] - forecast.initial_times[:, None]
    table.insert(0, "time", quantile(np.where(np.isnan(worst), np.nan, elapsed), 0.5))

    below = np.flatnonzero(table["lower"].to_numpy() < share)
    trusted = int(below[0]) if len(below) else len(table)
    limit = "forecast"
    if len(below):
        enough = table["n_episodes"].iloc[trusted] >= _needed(share, confidence)
        limit = "tolerance" if enough else "episodes"
    return TrustHorizon(
        horizon=trusted,
        time=float(table["time"].iloc[trusted - 1]) if trusted else 0.0,
        limit=limit,
        share=share,
        confidence=confidence,
        tolerance=dict(tolerance) if isinstance(tolerance, Mapping) else tolerance,
        n_episodes=len(reach),
        table=table,
    )


def _check_settings(tolerance: Tolerance, share: float, confidence: float) -> None:
    for name, value in (("share", share), ("confidence", confidence)):
        if not 0 < value < 1:
            raise ValueError(f"{name} = {value!r} must lie between 0 and 1.")
    limits = tolerance if isinstance(tolerance, Mapping) else {"": tolerance}
    for state, value in limits.items():
        if not 0 < value < np.inf:
            of = f" of state {state!r}" if state else ""
            raise ValueError(f"tolerance{of} = {value!r} must be a positive, finite number.")
    if not limits:
        raise ValueError("tolerance names no state: give a number or {state: greatest error}.")


def _forecast(
    forecaster: Any, ds: TrajectoryDataset, horizon: int | None, start: ArrayLike | None
) -> Forecast:
    if isinstance(forecaster, Forecast):
        if start is not None:
            raise ValueError("start: a ready forecast has its own; give the estimator instead.")
        return forecaster
    if start is not None:
        return predicted_states(forecaster, ds, start=start)
    # cut instead of horizon=: shorter episodes are then not forecast past their end
    return predicted_states(forecaster, ds if horizon is None else ds.truncate(horizon))


def _excess(forecast: Forecast, truth: TrajectoryDataset, tolerance: Tolerance) -> Floats:
    """Error over tolerance (n, H): above 1 outside, NaN where there is no such step."""
    ds = with_states_of(forecast, truth)
    squared = forecast.squared_errors(ds)
    check_same_times(forecast, ds)
    if not np.array_equal(forecast.horizons, np.arange(1, len(forecast.horizons) + 1)):
        raise ValueError(
            "the forecast leaves out steps, so it is unknown whether the error stays within the "
            "tolerance: give the whole forecast, not that at some horizons."
        )
    if not isinstance(tolerance, Mapping):
        scaled: Floats = np.sqrt(squared.mean(axis=2)) / tolerance
        return scaled
    columns, names, _ = shared_states(forecast.state_names, ds)
    unknown = [name for name in tolerance if name not in names]
    if unknown:
        raise ValueError(
            f"tolerance: no state {', '.join(unknown)} was both forecast and logged; there are "
            f"{', '.join(names)}."
        )
    low, high = forecast.state_range[:, columns]
    width = np.where(high > low, high - low, 1.0)
    errors = np.sqrt(squared) * width
    chosen = [errors[..., names.index(name)] / limit for name, limit in tolerance.items()]
    worst: Floats = np.max(chosen, axis=0)
    return worst


def _by_episode(worst: Floats, episode: Ints) -> tuple[Ints, Ints]:
    """First step outside the tolerance (H + 1 if none) and last step, of each episode."""
    n_steps = worst.shape[1]
    outside = worst > 1.0
    first = np.where(outside.any(axis=1), outside.argmax(axis=1) + 1, n_steps + 1)
    last = (~np.isnan(worst)).sum(axis=1)
    _, index = np.unique(episode[last > 0], return_inverse=True)
    n_episodes = int(index.max()) + 1 if len(index) else 0
    failed_at, reach = np.full(n_episodes, n_steps + 1), np.zeros(n_episodes, dtype=np.intp)
    np.minimum.at(failed_at, index, first[last > 0])
    np.maximum.at(reach, index, last[last > 0])
    return failed_at, reach


def _table(failed_at: Ints, reach: Ints, n_steps: int, confidence: float) -> "pd.DataFrame":
    """Shares within the tolerance by horizon, with their lower bounds."""
    import pandas as pd

    steps = np.arange(1, n_steps + 1)[:, None]
    n_within = ((failed_at > steps) & (reach >= steps)).sum(axis=1)
    n_counted = n_within + (failed_at <= steps).sum(axis=1)
    table = pd.DataFrame(
        {
            "n_episodes": n_counted,
            "n_within": n_within,
            "share_within": n_within / np.where(n_counted > 0, n_counted, np.nan),
            "lower": _lower_bound(n_within, n_counted, confidence),
        },
        index=pd.Index(steps[:, 0], name="horizon"),
    )
    return table


def _lower_bound(n_within: Ints, n: Ints, confidence: float) -> Floats:
    """One-sided lower confidence bound of a share, exact (Clopper and Pearson 1934)."""
    some = n_within > 0
    k = np.where(some, n_within, 1)
    bound = betaincinv(k, np.where(some, n - k + 1, 1), 1.0 - confidence)
    return np.asarray(np.where(some, bound, 0.0), dtype=np.float64)


def _needed(share: float, confidence: float) -> int:
    """Fewest episodes that could show the share: all of them within the tolerance."""
    n = max(1, ceil(log(1.0 - confidence) / log(share)) - 1)
    # the logarithms may be off by a rounding: ask the bound that decides
    while _lower_bound(np.array(n), np.array(n), confidence) < share:
        n += 1
    return n


def _check_enough(n: int, share: float, confidence: float) -> None:
    needed = _needed(share, confidence)
    if n < needed:
        most = (1.0 - confidence) ** (1.0 / n) if n else 0.0
        raise ValueError(
            f"{n} episodes can show at most a share of {most:.3f} with confidence {confidence}, "
            f"if all of them stay within the tolerance: give at least {needed} for share={share}, "
            "or lower share= or confidence=."
        )
