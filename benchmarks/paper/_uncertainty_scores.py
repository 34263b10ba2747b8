"""Scores of forecasts with an uncertainty: raw, and calibrated on other episodes."""

import warnings
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator

from trajlearn import CalibratedForecaster, Forecast, TrajectoryDataset, calibration_report
from trajlearn.evaluation import crps, energy_scores, interval_hits
from trajlearn.evaluation._bootstrap import horizon_bins

Floats = NDArray[np.float64]

#: Level of the intervals that are checked, and all levels.
LEVEL = 0.9
LEVELS = (0.5, LEVEL, 0.95)
#: Horizons of the growth of an uncertainty.
SHOWN = (1, 2, 5, 10, 20, 50, 75, 100, 150, 200)
#: Measures of the report that have no level.
MEASURES = (
    "crps",
    "nll",
    "calibration_error",
    "spread_skill",
    "error_std_correlation",
    "energy_score",
)
_N_RESAMPLES, _TAIL = 500, 0.025
# episodes forecast at once: particles of all would not fit into memory
_CHUNK = 100


class Replay(BaseEstimator):
    """Forecasts of episodes that were made before: calibrating does not make them again.

    Parameters
    ----------
    forecast : Forecast
    ids : list
        Of the episodes, in the order of the forecasts.
    """

    def __init__(self, forecast: Forecast, ids: list[Any]) -> None:
        self.forecast = forecast
        self.ids = ids

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def predict(self, X: TrajectoryDataset, return_std: bool = False, **_: Any) -> Forecast:
        """The forecasts of these episodes, whatever else is asked."""
        position = {label: i for i, label in enumerate(self.ids)}
        return self.forecast[np.array([position[label] for label in X.ids.tolist()])]


def forecast_of(model: Any, ds: TrajectoryDataset, *, seed: int, **asked: Any) -> Forecast:
    """Mean and standard deviation from the first state of every episode."""
    parts = []
    for first in range(0, len(ds), _CHUNK):
        rng = np.random.RandomState([seed, first])
        some = ds[first : first + _CHUNK]
        parts.append(model.predict(some, return_std=True, random_state=rng, **asked))
    return np.concatenate(parts)


def calibrated(
    forecasts: dict[str, Forecast],
    calibration: TrajectoryDataset,
    test: TrajectoryDataset,
    **settings: Any,
) -> Forecast:
    """Forecasts of the test episodes, calibrated on the calibration episodes alone.

    Parameters
    ----------
    forecasts : dict
        "calibration" and "test", of more episodes or these.
    calibration, test : TrajectoryDataset
        With ids of their own.
    **settings
        Of `CalibratedForecaster`.
    """
    both = np.concatenate([forecasts["calibration"], forecasts["test"]])
    ids = forecasts_ids(calibration, test)
    model = CalibratedForecaster(FrozenEstimator(Replay(both, ids)), **settings)
    return model.fit(calibration).predict(test, return_std=True)


def forecasts_ids(*parts: TrajectoryDataset) -> list[Any]:
    """Ids of episodes of several datasets, which must all differ."""
    ids = [label for part in parts for label in part.ids.tolist()]
    if len(set(ids)) != len(ids):
        raise ValueError("an episode is for calibration and for test.")
    return ids


def scores(forecast: Forecast, truth: TrajectoryDataset) -> list[dict[str, Any]]:
    """A line a bin of horizons, pooled over the states."""
    with warnings.catch_warnings():
        # infinite scores of what diverged are the result, not a surprise
        warnings.simplefilter("ignore", RuntimeWarning)
        report = calibration_report(forecast, truth, levels=LEVELS, n_bootstrap=0)
    report = report[report["state"] == "all"]
    return [_line(some) for _, some in report.groupby(["first", "last"], sort=True)]


def _line(report: pd.DataFrame) -> dict[str, Any]:
    head = report.iloc[0]
    line = {name: int(head[name]) for name in ("first", "last", "n_episodes", "n_diverged")}
    by_level = report.set_index(["measure", "level"])
    for level in LEVELS:
        line[_coverage(level)] = by_level.at[("coverage", level), "value"]
    for name in ("low", "high"):
        line[name] = by_level.at[("coverage", LEVEL), name]
    line["width"] = by_level.at[("width", LEVEL), "value"]
    plain = report.drop_duplicates("measure").set_index("measure")["value"]
    return line | {name: plain[name] for name in MEASURES if name in plain}


def _coverage(level: float) -> str:
    """Column of the coverage of a level."""
    return f"coverage{100 * level:.0f}"


def brief(forecast: Forecast, truth: TrajectoryDataset) -> list[dict[str, Any]]:
    """The coverage and the CRPS of `scores` alone, which take a tenth of the time."""
    values = {_coverage(level): interval_hits(forecast, truth, level) for level in LEVELS}
    values["crps"] = crps(forecast, truth)
    episodes = {"n_episodes": len(forecast), "n_diverged": int((forecast.diverged_at > 0).sum())}
    low, high = bounds(by_episode(values[_coverage(LEVEL)]), np.arange(len(forecast)))
    lines = []
    for i, (first, last) in enumerate(bins_of(len(forecast.horizons))):
        line = {"first": first, "last": last} | episodes | {"low": low[i], "high": high[i]}
        lines.append(line | {k: some[:, first - 1 : last].mean() for k, some in values.items()})
    return lines


def bins_of(n_steps: int) -> list[tuple[int, int]]:
    """Standard bins of the report of calibration, as far as a forecast goes."""
    found = horizon_bins(np.arange(1, n_steps + 1), "standard")
    return [(some.first, some.last) for some in found]


def by_episode(hits: Floats) -> Floats:
    """Share of the steps and states of each bin that are hits (n, n_bins)."""
    bins = bins_of(hits.shape[1])
    means = [hits[:, first - 1 : last].mean(axis=(1, 2)) for first, last in bins]
    return np.stack(means, axis=1)


def bounds(shares: Floats, group: NDArray[Any]) -> tuple[Floats, Floats]:
    """Bootstrap interval (95 %) of the mean share of each bin.

    Parameters
    ----------
    shares : ndarray of shape (n, n_bins)
    group : ndarray of shape (n,)
        What is drawn with replacement: episodes, or experiments of several.
    """
    names, member = np.unique(group, return_inverse=True)
    total, count = np.zeros((len(names), shares.shape[1])), np.bincount(member)
    np.add.at(total, member, shares)
    drawn = np.random.default_rng(0).integers(len(names), size=(_N_RESAMPLES, len(names)))
    means = total[drawn].sum(axis=1) / count[drawn].sum(axis=1)[:, None]
    low, high = np.quantile(means, [_TAIL, 1 - _TAIL], axis=0)
    return low, high


def sampled(forecast: Forecast, truth: TrajectoryDataset) -> list[dict[str, Any]]:
    """CRPS of the Gaussian and of the samples, and the energy score, a line a bin."""
    assert forecast.samples is not None  # asked for
    values = {
        "gaussian": crps(forecast, truth, distribution="gaussian"),
        "samples": crps(forecast, truth, distribution="samples"),
        "energy": energy_scores(forecast, truth),
    }
    sizes = {"n_samples": len(forecast.samples), "n_episodes": len(forecast)}
    return [
        {"first": first, "last": last}
        | sizes
        | {name: some[:, first - 1 : last].mean() for name, some in values.items()}
        for first, last in bins_of(len(forecast.horizons))
    ]


def growth(forecast: Forecast, truth: TrajectoryDataset) -> list[dict[str, Any]]:
    """Typical standard deviation and typical error by horizon, in training ranges.

    Of each forecast the root of the mean over states, then the median over episodes; infinite
    after a divergence.
    """
    assert forecast.std is not None  # asked for
    width = np.ptp(forecast.state_range, axis=0)
    squared = forecast.squared_errors(truth)
    with np.errstate(over="ignore", invalid="ignore"):
        variance = (forecast.std / np.where(width > 0, width, 1.0)) ** 2
    lines = []
    for h in SHOWN:
        if h > squared.shape[1]:
            break
        pair = {"std": variance[:, h - 1], "error": squared[:, h - 1]}
        roots = {name: np.sqrt(values.mean(axis=1)) for name, values in pair.items()}
        lines.append({"horizon": h} | {name: np.median(some) for name, some in roots.items()})
    return lines


def whole(forecast: Forecast, truth: TrajectoryDataset) -> dict[str, float]:
    """Share of trajectories inside the interval at every step: of each state, and of all states."""
    inside = interval_hits(forecast, truth, LEVEL).all(axis=1)
    return {"state": float(inside.mean()), "joint": float(inside.all(axis=1).mean())}
