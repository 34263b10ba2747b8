"""Promises about scores, and about forecasts that diverge."""

import warnings
from typing import Any

import numpy as np

from trajlearn.exceptions import DivergenceWarning
from trajlearn.testing._case import Case, NotApplicable, require
from trajlearn.testing._system import rebuilt


def check_score_is_minus_the_normalised_error(case: Case) -> None:
    """`score` is minus the squared error in training ranges, averaged over steps, then episodes."""
    squared = _normalised(case, case.fitted.predict(case.test).mean)
    expected = -np.mean([np.nanmean(episode) for episode in squared])
    found = case.fitted.score(case.test)
    require(np.isclose(found, expected, rtol=1e-6), f"score {found:g}, by hand {expected:g}.")


def check_divergence_counts_error_score(case: Case) -> None:
    """A diverged forecast is inf from there on, warns once, and scores `error_score`."""
    error_score = getattr(case.fitted, "error_score", None)
    if error_score is None:
        raise NotApplicable
    states = [episode.states for episode in case.test]
    far = rebuilt(case.test, states=[states[0] * 1e9, *states[1:]])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        forecast = case.fitted.predict(far)
    n_warnings = sum(issubclass(item.category, DivergenceWarning) for item in caught)
    diverged = forecast.diverged_at > 0
    require(n_warnings == diverged.any(), f"{n_warnings} DivergenceWarning for {diverged.sum()}.")
    for i in np.flatnonzero(diverged):
        after = forecast.mean[i, forecast.diverged_at[i] - 1 : forecast.lengths[i]]
        require(np.isposinf(after).all(), "states after the divergence are not inf.")
    before = np.where(np.isposinf(forecast.mean), np.nan, forecast.mean)
    require(not np.isinf(before).any(), "an episode that did not diverge has infinite states.")
    squared = _normalised(case, forecast.mean, far)
    each = [max(-np.nanmean(errors), error_score) for errors in squared]
    found = case.fitted.score(far)
    require(np.isclose(found, np.mean(each), rtol=1e-6), f"score {found:g}, not {np.mean(each):g}.")


def _normalised(case: Case, mean: np.ndarray, truth: Any = None) -> np.ndarray:
    """Squared errors in training ranges (n, H, d_s), NaN in the padding."""
    low, high = case.train.states.min(axis=0), case.train.states.max(axis=0)
    logged = np.full(mean.shape, np.nan)
    for i, episode in enumerate(case.test if truth is None else truth):
        logged[i, : episode.length] = episode.states[1:]
    with np.errstate(invalid="ignore"):
        return ((mean - logged) / (high - low)) ** 2
