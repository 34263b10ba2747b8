"""Episodes and estimators whose errors are known by hand."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin

from trajlearn import Forecast, TrajectoryDataset


class Persistence(BaseEstimator):
    """Predicts that nothing moves; explodes at the step `diverges_at` if told to."""

    def __init__(self, *, diverges_at=0, offset=0.0):
        self.diverges_at = diverges_at
        self.offset = offset

    def fit(self, ds, y=None):
        self.state_range_ = np.stack([ds.states.min(axis=0), ds.states.max(axis=0)])
        self.trained_on_ = ds
        return self

    def predict(self, ds, *, start=0, horizon=None):
        rows = ds.state_rows(start)
        start = np.broadcast_to(start, len(ds))
        lengths = ds.lengths - start
        if horizon is not None:
            lengths = np.minimum(lengths, horizon)
        steps = np.arange(1, lengths.max() + 1)
        asked = steps <= lengths[:, None]
        mean = np.repeat(ds.states[rows][:, None] + self.offset, len(steps), axis=1)
        mean[~asked] = np.nan
        diverged_at = np.where(lengths >= self.diverges_at, self.diverges_at, 0)
        if self.diverges_at:
            mean[asked & (steps >= self.diverges_at)] = np.inf
        times = ds.times[np.where(asked, rows[:, None] + steps, rows[:, None])]
        return Forecast(
            mean,
            times=np.where(asked, times, np.nan),
            horizons=steps,
            lengths=lengths,
            initial_states=ds.states[rows],
            initial_times=ds.times[rows],
            start=start.astype(np.intp),
            diverged_at=diverged_at,
            state_range=self.state_range_,
            state_names=ds.state_names,
        )


class StateSelector(TransformerMixin, BaseEstimator):
    """A transformer from dataset to dataset."""

    def __init__(self, names):
        self.names = names

    def fit(self, ds, y=None):
        return self

    def transform(self, ds):
        return ds.select_states(self.names)


@pytest.fixture(scope="session")
def persistence():
    return Persistence


@pytest.fixture(scope="session")
def state_selector():
    return StateSelector


def ramps(slopes, lengths, **fields):
    """State 0 climbs by `slope` a step, state 1 is ten times as large."""
    states = [
        slope * np.arange(length + 1.0)[:, None] * [1.0, 10.0]
        for slope, length in zip(slopes, lengths)
    ]
    return TrajectoryDataset.from_arrays(states, state_names=["x", "y"], **fields)


@pytest.fixture(scope="session")
def make_ramps():
    return ramps


@pytest.fixture(scope="session")
def decays():
    """Twelve damped motions of 20 steps, s_t = exp(-theta t / 10), with their theta."""
    rate = np.linspace(0.5, 1.5, 12)[:, None]
    states = np.exp(-rate * 0.1 * np.arange(21))[..., None]
    return TrajectoryDataset.from_arrays(states, params=rate, dt=0.1, group=np.arange(12) // 2)
