"""Promises about the shape and content of a forecast."""

import numpy as np

from trajlearn.testing._case import Case, NotApplicable, refused, require
from trajlearn.testing._system import DT


def check_forecast_has_the_shapes_of_the_log(case: Case) -> None:
    """A forecast has a state for every logged step after the start, and NaN beyond an episode."""
    for fitted, ds in case.trained:
        forecast = fitted.predict(ds)
        lengths, n_steps = ds.lengths, int(ds.lengths.max())
        require(forecast.mean.shape == (len(ds), n_steps, 2), f"mean is {forecast.mean.shape}.")
        require(np.array_equal(forecast.lengths, lengths), f"lengths are {forecast.lengths}.")
        require(
            np.array_equal(forecast.horizons, np.arange(1, n_steps + 1)),
            f"horizons are {forecast.horizons}.",
        )
        beyond = np.arange(n_steps) >= lengths[:, None]
        require(
            np.array_equal(np.isnan(forecast.mean), np.repeat(beyond[..., None], 2, axis=2)),
            "NaN is not exactly where the episodes have ended.",
        )
        times = np.full(beyond.shape, np.nan)
        for i, episode in enumerate(ds):
            times[i, : episode.length] = episode.times[1:]
        require(np.allclose(forecast.times, times, equal_nan=True), "times are not those logged.")
        require(forecast.std is None and forecast.samples is None, "uncertainty, though not asked.")
        require(tuple(forecast.state_names) == ds.state_names, f"names {forecast.state_names}.")
        first = ds.states[ds.offsets[:-1]]
        require(np.array_equal(forecast.initial_states, first), "initial_states are others.")


def check_starts_agree(case: Case) -> None:
    """`start` may be an index, one an episode, or several an episode, with the same result."""
    for settings in case.sources:
        single = [case.fitted.predict(case.test, start=k, **settings) for k in range(3)]
        starts = np.arange(len(case.test)) % 3
        several = np.stack([starts, 2 - starts], axis=1)
        own = case.fitted.predict(case.test, start=starts, **settings)
        both = case.fitted.predict(case.test, start=several, **settings)
        require(len(both) == 2 * len(case.test), f"{len(both)} forecasts for two starts each.")
        for i, k in enumerate(starts):
            steps = case.test.lengths[i] - k
            require(own.lengths[i] == steps, f"length {own.lengths[i]} from start {k}.")
            expected = single[k].mean[i, :steps]
            case.require_same(own.mean[i, :steps], expected, f"start (n,) at {k}", exact=False)
            at = int(np.flatnonzero((both.episode == i) & (both.start == k))[0])
            case.require_same(both.mean[at, :steps], expected, f"(n, k) at {k}", exact=False)


def check_horizon_cuts_and_extends(case: Case) -> None:
    """`horizon` cuts a forecast; past the log it goes on, unless logged actions end there."""
    for settings in case.sources:
        whole = case.fitted.predict(case.test, **settings)
        short = case.fitted.predict(case.test, horizon=3, **settings)
        require((short.lengths == 3).all(), f"horizon=3 gives lengths {short.lengths}.")
        case.require_same(short.mean, whole.mean[:, :3], "horizon=3", exact=False)
        last = case.test.lengths - 1
        beyond = case.fitted.predict(case.test, start=last, horizon=4, **settings)
        if beyond.actions == "logged":
            require((beyond.lengths == 1).all(), f"lengths {beyond.lengths} past logged actions.")
            continue
        require((beyond.lengths == 4).all(), f"past the log, lengths are {beyond.lengths}.")
        require(np.isfinite(beyond.mean).all(), "past the log, states are not finite.")
        ahead = beyond.initial_times[:, None] + DT * np.arange(1, 5)
        require(np.allclose(beyond.times, ahead), "past the log, times leave the grid.")


def check_forecast_behaves_like_an_array_of_episodes(case: Case) -> None:
    """A forecast has a length, is indexed and joined by episode, and is its mean as an array."""
    whole = case.fitted.predict(case.test)
    n = len(case.test)
    require(len(whole) == n and whole.shape == (n,), f"length {len(whole)}, shape {whole.shape}.")
    case.require_same(np.asarray(whole), whole.mean, "np.asarray(forecast)")
    mask = np.arange(n) % 2 == 0
    for key in (slice(1, 3), mask, np.array([4, 0]), (np.array([2, 5]), ...)):
        index = key[0] if isinstance(key, tuple) else key
        case.require_same(whole[key].mean, whole.mean[index], f"forecast[{key}]")
        require(np.array_equal(whole[key].lengths, whole.lengths[index]), "lengths when indexed.")
    parts = [case.fitted.predict(case.test[:3]), case.fitted.predict(case.test[3:])]
    joined = np.concatenate(parts)
    case.require_same(joined.mean, whole.mean, "np.concatenate of two parts", exact=False)


def check_forecast_is_predict(case: Case) -> None:
    """`forecast(X, ...)` and `predict(X, ...)` of episodes are the same."""
    if not hasattr(case.fitted, "forecast"):
        raise NotApplicable
    for settings in case.sources:
        settings = {"start": 2, "horizon": 3, **settings}
        case.require_same(
            case.fitted.forecast(case.test, **settings),
            case.fitted.predict(case.test, **settings),
            f"forecast against predict with {settings}",
        )


def check_planning_is_forecasting(case: Case) -> None:
    """`predict_trajectory` of a state, theta and times is the forecast of such an episode."""
    if not hasattr(case.fitted, "predict_trajectory"):
        raise NotApplicable
    ahead = DT * np.arange(1, 5)
    for settings in case.sources:
        expected = case.fitted.predict(case.test, horizon=4, **settings)
        actions = None
        if expected.actions == "logged":
            actions = np.stack([episode.actions[:4] for episode in case.test])
        found = case.fitted.predict_trajectory(
            expected.initial_states,
            params=case.test.params,
            actions=actions,
            policy=settings.get("policy"),
            horizons=ahead,
        )
        gap = np.abs(found.mean - expected.mean).max()
        require(gap <= 1e-5 * case.range, f"they differ by {gap:g}.")
        require(np.allclose(found.horizons, ahead), f"horizons are {found.horizons}.")


def check_bad_starts_and_horizons_are_refused(case: Case) -> None:
    """A start outside the episode, not whole or of the wrong length, and no horizon, raise."""
    predict = case.fitted.predict
    for start in (case.test.lengths.max() + 1, -1, 0.5, [0, 0]):
        refused(f"{start=}", predict, case.test, start=start)
    for horizon in (0, -2, 1.5):
        refused(f"{horizon=}", predict, case.test, horizon=horizon)
    refused('actions="guessed"', predict, case.test, actions="guessed")
