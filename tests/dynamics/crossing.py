"""Forecasters with known errors, for those who choose between them."""

import numpy as np

from trajlearn import TrajectoryDataset
from trajlearn.dynamics._forecaster import Prediction
from trajlearn.dynamics.baselines import EpisodeForecaster


class Off(EpisodeForecaster):
    """Knows s_h = 0.9^h s_0 and is off by `early` to step `until`, by `late` afterwards.

    With `by_param` it is off by that times the first param of the episode. It diverges in
    episodes whose param is above `diverges`.
    """

    _parameter_constraints = {}  # noqa: RUF012

    def __init__(
        self, early=0.0, late=0.0, *, until=10, by_param=False, diverges=np.inf, std=None, goes=None
    ):
        self.early = early
        self.late = late
        self.until = until
        self.by_param = by_param
        self.diverges = diverges
        self.std = std
        self.goes = goes

    def _forecast(self, query, request):
        step = np.arange(1, query.n_steps + 1)[None, :, None]
        off = np.where(step <= self.until, self.early, self.late)
        theta = query.params()[:, :1, None]
        mean = 0.9**step * query.initial_states[:, None] + off * (theta if self.by_param else 1.0)
        mean = np.where((theta > self.diverges) & (step > 5), np.inf, mean)
        if self.goes is not None:
            query.lengths[:] = np.minimum(query.lengths, self.goes)
        if self.std is None:
            self._refuse_uncertainty(request)
            return Prediction(mean)
        std = np.full(mean.shape, float(self.std)) if request.return_std else None
        samples = None
        if request.n_samples:
            noise = request.rng.standard_normal((request.n_samples, len(mean), 1, 1))
            samples = mean + self.std * noise
        return Prediction(mean, std, samples)


def decays(n=24, *, noise=0.01, steps=40, seed=0, lengths=None, **fields):
    """s_t = 0.9^t s_0 with measurement noise, s_0 in [1, 2], one param in [0, 1]."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(1, 2, size=(n, 1))
    states = first[:, None] * 0.9 ** np.arange(steps + 1)[None, :, None]
    states = states + noise * rng.normal(size=states.shape)
    states[:, 0] = first
    lengths = np.full(n, steps) if lengths is None else lengths
    params = np.linspace(0, 1, n)[:, None]
    kept = [s[: k + 1] for s, k in zip(states, lengths)]
    return TrajectoryDataset.from_arrays(kept, params=params, dt=0.1, **fields)
