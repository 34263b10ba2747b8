"""What no model can do better: the plant itself, from the best guess of where an episode starts."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._tasks import environment
from benchmarks.regimes._episodes import Episodes, cart, episodes
from benchmarks.regimes._peers import roll_out
from benchmarks.regimes._regimes import REGIMES, Regime
from benchmarks.regimes._scores import scores
from trajlearn import TrajectoryDataset
from trajlearn.envs.base import Environment

Floats = NDArray[np.float64]

NAME = "plant"
# draws of the start of an episode
_STARTS, _SEED = 20_000, 9_001


class Plant:
    """The simulator, without process noise."""

    def __init__(self, env: Environment) -> None:
        self.env = env

    def step(self, states: Floats, inputs: Floats) -> Floats:
        """States one step later; inputs are actions."""
        return self.env.step(states, inputs)


def has_floor(regime: Regime) -> bool:
    """Whether the floor is known: every state and step is logged, and the error is not zero."""
    uncertain = regime.noise or regime.process or regime.system == "quadrotor"
    plain = regime.system != "flights" and regime.every == 1 and not regime.states
    return bool(plain and uncertain and not regime.acts_on_noise)


def cell(system: str, regime: str, floor: str, mode: str, seed: int) -> dict[str, Any]:
    """Errors of the plant under the known policy, from the start that is most likely.

    The start is the mean of what remains possible given its measurement, if starts and noise were
    Gaussian; ``floor`` names the model in tables.
    """
    what = REGIMES[system, regime]
    data = episodes(what, seed, mode)
    task = {"quadrotor": "quadrotor-sim"}.get(system, system)
    env = cart(what.gains) if system == "cartpole" else environment(task)
    everywhere = np.array([[-np.inf], [np.inf]]).repeat(len(data.span), axis=1)
    predicted = roll_out(Plant(env), likely_starts(data, env), everywhere, data.policy)
    return {"scores": scores(predicted, data), "model": floor}


def likely_starts(data: Episodes, env: Environment) -> TrajectoryDataset:
    """The test episodes, their first states replaced by the mean of the posterior."""
    starts = env.reset(_STARTS, random_state=_SEED)
    mean, covariance = starts.mean(axis=0), np.cov(starts.T)
    # a state that always starts at the same value is known
    gain = covariance @ np.linalg.pinv(covariance + np.diag(data.noise**2), hermitian=True)
    states = data.test.states.copy()
    first = data.test.offsets[:-1]
    states[first] = mean + (states[first] - mean) @ gain.T
    return TrajectoryDataset.from_arrays(
        np.split(states, data.test.offsets[1:-1]),
        actions=[episode.actions for episode in data.test],
        params=data.test.params,
        times=[episode.times for episode in data.test],
        **data.test.names,
    )
