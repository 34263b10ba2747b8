"""What process noise leaves to predict: the errors of the plant itself, simulated without it."""

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.paper._rollouts import N_TEST, shown_horizons, windows
from benchmarks.paper._tasks import environment, episodes, shape
from trajlearn import Quadrotor

#: How the plant is called in tables and legends.
EXACT = "exact plant"
# no limit: without noise nothing ends what went on with it
_NO_LIMIT = 1.5


def cell(task: str, mode: str, seed: int) -> dict[str, Any]:
    """Errors of the noise-free simulation of the test episodes, from their first states and gains.

    About what the best possible model has: it knows the equations, but no more of the noise.

    Returns
    -------
    dict
        ``curve`` and ``windows`` as of `assess`.
    """
    env, (length, test_length) = environment(task), shape(task)
    if not isinstance(env, Quadrotor):
        raise ValueError(f"{task} has no process noise.")
    train, test = episodes(task, seed, n_test=N_TEST[mode], test_length=test_length)
    calm = replace(env, noise=0.0, tilt_limit=_NO_LIMIT)
    starts = np.array([episode.states[0] for episode in test])
    gains = np.array([episode.params for episode in test])
    simulated = calm.rollout(starts, gains, test_length)
    span = np.ptp(train.states, axis=0)
    pairs = zip(simulated, test, strict=True)
    scaled = np.array([(own.states[1:] - true.states[1:]) / span for own, true in pairs])
    errors = (scaled**2).mean(axis=2)
    horizons = shown_horizons(test_length)
    shown = errors[:, horizons - 1]
    q65, q95 = np.quantile(shown, [0.65, 0.95], axis=0)
    curve = {"median": np.median(shown, axis=0), "q65": q65, "q95": q95}
    return {
        "curve": {"horizon": horizons, **curve, "n_diverged": np.zeros_like(horizons)},
        "windows": {name: errors[:, where].mean(axis=1) for name, where in windows(length).items()},
    }
