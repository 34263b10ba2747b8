"""A quick MLP ensemble and something for it to learn."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn import MLPEnsembleRegressor

Floats = NDArray[np.float64]


def small(**params: Any) -> MLPEnsembleRegressor:
    """A quick one: 30 steps of one small layer."""
    defaults = {"hidden_layer_sizes": (16,), "max_steps": 30, "random_state": 0}
    return MLPEnsembleRegressor(**(defaults | params))


def data(
    n: int = 60, n_targets: int = 2, seed: int = 0, noise: float = 0.0
) -> tuple[Floats, Floats]:
    """Smooth targets of three inputs."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 3))
    y = np.stack([np.sin(3 * X[:, 0]) + X[:, k % 3] ** 2 for k in range(n_targets)], axis=1)
    return X, y + noise * rng.normal(size=y.shape)


def clean(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
    """A stream of rows of uniform inputs."""
    X = rng.uniform(-1, 1, (n, 3))
    return X, np.stack([np.sin(3 * X[:, 0]), X[:, 1] * X[:, 2]], axis=1), None
