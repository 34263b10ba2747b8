"""Forecasters with known errors, and episodes to calibrate them on."""

import numpy as np

from trajlearn import TrajectoryDataset
from trajlearn.dynamics._forecaster import Prediction
from trajlearn.dynamics.baselines import EpisodeForecaster


class Decay(EpisodeForecaster):
    """Mean a^h s_0 and the std of s' = a s + w, w of variance 1, times `factor`.

    With `by_params` the std of an episode is also multiplied by its first param.
    """

    _parameter_constraints = {}  # noqa: RUF012

    def __init__(self, a=0.9, *, factor=1.0, by_params=False, gives_std=True):
        self.a = a
        self.factor = factor
        self.by_params = by_params
        self.gives_std = gives_std

    def _forecast(self, query, request):
        step = np.arange(1, query.n_steps + 1)[None, :, None]
        mean = self.a**step * query.initial_states[:, None]
        if not self.gives_std:
            self._refuse_uncertainty(request)
        std = None
        if request.return_std:
            power = self.a ** (2 * np.arange(query.n_steps))
            std = self.factor * np.sqrt(np.cumsum(power))[None, :, None] * np.ones_like(mean)
            if self.by_params:
                std = std * query.params()[:, :1, None]
        return Prediction(mean, std)


def decays(n, *, seed, a=0.9, d_s=2, shortest=12, longest=12, noise="normal", start=1.0):
    """s' = a s + w, whose noise w of each episode is multiplied by its param."""
    rng = np.random.default_rng(seed)
    states, params = [], rng.uniform(0.5, 2.0, size=(n, 1))
    for theta, steps in zip(params, rng.integers(shortest, longest + 1, size=n)):
        s = [start * rng.normal(size=d_s)]
        for _ in range(steps):
            w = rng.normal(size=d_s) if noise == "normal" else rng.standard_t(2, size=d_s)
            s.append(a * s[-1] + theta * w)
        states.append(np.array(s))
    return TrajectoryDataset.from_arrays(states, params=params, dt=0.1)
