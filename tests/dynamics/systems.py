"""Systems whose answers are known, and learners that can represent them exactly."""

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures

from trajlearn import TrajectoryDataset

A = np.array([[0.9, 0.2], [-0.3, 0.8]])
B = np.array([[0.1], [0.5]])
SMALL = {"estimator__hidden_layer_sizes": (16,), "estimator__max_steps": 40}


def linear(n=8, *, seed=0, shortest=5, longest=12, scale=1.0, params=True, **fields):
    """s' = A s + B a, ragged; a = -theta s + noise, theta = two gains."""
    rng = np.random.default_rng(seed)
    episodes = {"states": [], "actions": [], "params": []}
    for steps in rng.integers(shortest, longest + 1, size=n):
        theta, states = rng.uniform(0, 0.4, size=2), [scale * rng.normal(size=2)]
        actions = []
        for _ in range(steps):
            actions.append([-theta @ states[-1] + scale * 0.3 * rng.normal()])
            states.append(A @ states[-1] + B @ actions[-1])
        episodes["states"].append(states)
        episodes["actions"].append(actions)
        episodes["params"].append(theta)
    if not params:
        del episodes["params"]
    return TrajectoryDataset.from_arrays(**episodes, **fields)


def closed_loop(n=10, *, seed=0, steps=8, switch=None, noise=0.0):
    """s' = s + theta (0.3 - 0.2 s) - 0.1 s, exactly of second degree in (s, theta).

    theta changes to another value at the step `switch`.
    """
    rng = np.random.default_rng(seed)
    states, params = [], []
    for _ in range(n):
        theta = np.full((steps, 1), rng.uniform(0.2, 1.0))
        theta[steps if switch is None else switch :] = rng.uniform(-1.0, -0.2)
        s = [rng.normal(size=1)]
        for t in range(steps):
            s.append(s[-1] + theta[t] * (0.3 - 0.2 * s[-1]) - 0.1 * s[-1])
        states.append(np.array(s) + noise * rng.normal(size=(steps + 1, 1)))
        params.append(theta)
    return TrajectoryDataset.from_arrays(states, params=params)


def quadratic():
    """Learner of all polynomials of degree two."""
    return make_pipeline(PolynomialFeatures(2), LinearRegression())


def gain_policy(states, params, times):
    return -(states * params).sum(axis=1, keepdims=True)


def truth(ds):
    """Logged states after the first (n, H, d_s), NaN beyond an episode."""
    out = np.full((len(ds), ds.lengths.max(), ds.states.shape[1]), np.nan)
    for i, episode in enumerate(ds):
        out[i, : episode.length] = episode.states[1:]
    return out


class Affine(RegressorMixin, BaseEstimator):
    """Learner that needs no learning: y = slope * first columns + offset, with a known std."""

    def __init__(self, slope=1.0, offset=0.0, std=0.0):
        self.slope = slope
        self.offset = offset
        self.std = std

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def fit(self, X, y, sample_weight=None):
        self.n_targets_ = 1 if y.ndim == 1 else y.shape[1]
        return self

    def predict(self, X, return_std=False):
        mean = self.slope * X[:, : self.n_targets_] + self.offset
        return (mean, np.full(mean.shape, self.std)) if return_std else mean
