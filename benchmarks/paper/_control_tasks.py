"""Cartpole and reacher as tasks of control: starts, rewards, bounds, ends, the best known return.

Returns are given per step, as in the paper's figures, so that trials of any length compare.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from trajlearn import Cartpole, Reacher, TrajectoryDataset
from trajlearn.envs.base import Environment
from trajlearn.trajectories.rewards import episode_rewards

Floats = NDArray[np.float64]

#: Factors of the cartpole's LQR gain that are searched, element by element.
FACTORS = (-0.1, 2.0)
# starts that the best known controller is found on; the first of them are the common test starts
_N_STARTS = {"cartpole": 100, "reacher": 2}
_N_TEST = {"cartpole": 50, "reacher": 2}
#: Where CMA-ES begins in the paper's code; two elements are outside the box of its text.
PAPER_START = np.array([[-1.0, -10.0, -48.0, -20.0]])
# what the best known controller may cost: random ones, and CMA-ES from the best of them (how many
# times, evaluations of each), since a reacher has several ways to its goal
_BUDGET = {
    "quick": {"cartpole": (50, 1, 150), "reacher": (100, 1, 150)},
    "full": {"cartpole": (200, 2, 800), "reacher": (400, 4, 1000)},
}


def upright(states: Floats) -> Floats:
    """Reward of stepping into a cartpole's states (..., 4): exp(-(x^2 + theta^2)), at most 1."""
    with np.errstate(over="ignore"):
        return np.exp(-(states[..., 0] ** 2 + states[..., 2] ** 2))


def near_goal(states: Floats) -> Floats:
    """Reward of stepping into a reacher's states (..., 15): minus the distance in m."""
    return Reacher().reward(states)


@dataclass(frozen=True)
class ControlTask:
    """What a controller has to do, and where it starts.

    Attributes
    ----------
    name : {"cartpole", "reacher"}
    length : int
        Steps of a trial.
    reward : callable
        ``reward(states (..., d_s)) -> (...)``, of stepping into a state; can be pickled.
    terminal_reward : float
        What each step after an early end is worth, and of a prediction that diverged: nothing
        on the cartpole, on the reacher (which never ends) the greatest distance there is.
    """

    name: str
    length: int
    reward: Callable[[Floats], Floats]
    terminal_reward: float

    @cached_property
    def env(self) -> Environment:
        """The simulator."""
        return Cartpole() if self.name == "cartpole" else Reacher()

    @property
    def is_terminal(self) -> Callable[[Floats], NDArray[np.bool_]] | None:
        """Whether a trial ends in a state; None where it never does."""
        return self.env.is_terminal if isinstance(self.env, Cartpole) else None

    @property
    def bounds(self) -> Floats:
        """Control parameters that are searched (p, 2), lower first."""
        if isinstance(self.env, Cartpole):
            return np.sort(np.outer(self.env.lqr_gain, FACTORS), axis=1)
        return self.env.param_bounds

    def starts(self, n: int, rng: Generator) -> Floats:
        """Draw initial states (n, d_s).

        The cartpole as in the paper's code of this experiment: position and angle within 0.25,
        speeds within 0.05.
        """
        if isinstance(self.env, Cartpole):
            return rng.uniform(-0.05, 0.05, (n, 4)) * np.array([5.0, 1.0, 5.0, 1.0])
        return self.env.reset(n, int(rng.integers(2**31)))

    @property
    def common_starts(self) -> Floats:
        """Initial states that the best known controller is found on (n, d_s)."""
        return self.starts(_N_STARTS[self.name], np.random.default_rng(2021))

    @property
    def test_starts(self) -> Floats:
        """The first of the common starts: every controller is scored on them (n, d_s)."""
        return self.common_starts[: _N_TEST[self.name]]

    @property
    def floor(self) -> float:
        """Return per step that counts as 0: on the reacher, of an arm that stays where it is."""
        if isinstance(self.env, Cartpole):
            return 0.0
        return float(self.true_return(np.zeros((1, len(self.bounds))))[0])

    def returns(self, trials: TrajectoryDataset) -> Floats:
        """Return per step of every trial (n,)."""
        return episode_rewards(
            trials, self.reward, horizon=self.length, terminal_reward=self.terminal_reward
        )

    def true_return(self, params: Floats, starts: Floats | None = None) -> Floats:
        """Mean return per step of controllers (m, p) over starts, in the simulator (m,).

        `starts` defaults to `test_starts`; they are the same for every controller.
        """
        at = self.test_starts if starts is None else starts
        flown = self.env.rollout(
            np.tile(at, (len(params), 1)), np.repeat(params, len(at), axis=0), self.length
        )
        return self.returns(flown).reshape(len(params), len(at)).mean(axis=1)


_REACHABLE = 2.6  # m; a stretched arm of 1.5 m points away from the default goal

CONTROL_TASKS = {
    "cartpole": ControlTask("cartpole", 200, upright, 0.0),
    "reacher": ControlTask("reacher", 500, near_goal, -_REACHABLE),
}


def normalised(returns: Any, floor: float, best: float) -> Any:
    """Returns per step on the scale of a task: 1 is the best known, 0 the floor."""
    return (returns - floor) / (best - floor)


def best_known(task: str, mode: str) -> dict[str, Any]:
    """A cell: the best constant controller that CMA-ES finds on the simulator itself.

    ``params``, ``per_step`` (over the common starts), ``test`` (over the test starts), and what
    the floor, the centre of the box and the paper's first guess are worth there.
    """
    from trajlearn.control._optimizers import maximise

    what = CONTROL_TASKS[task]
    n_random, n_climbs, n_evaluations = _BUDGET[mode][task]

    def value(params: Floats) -> Floats:
        return what.true_return(params, what.common_starts)

    low, high = what.bounds.T
    rng = np.random.default_rng(0)
    drawn = low + (high - low) * rng.random((n_random, len(low)))
    climbs = [
        maximise(
            value,
            what.bounds,
            method="cma",
            population=16,
            n_evaluations=n_evaluations,
            rng=rng,
            start=drawn[k],
        )
        for k in np.argsort(-value(drawn))[:n_climbs]
    ]
    found = max(climbs, key=lambda climb: climb.value)
    centre = what.bounds.mean(axis=1)
    test = what.true_return(np.stack([found.params, centre]))
    paper = {"paper_start": what.true_return(PAPER_START)[0]} if task == "cartpole" else {}
    return {
        "params": found.params,
        "per_step": found.value,
        "test": test[0],
        "centre": test[1],
        "floor": what.floor,
        "n_evaluations": n_random + sum(climb.n_evaluations for climb in climbs),
    } | paper
