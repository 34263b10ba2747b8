"""The paper's simulated tasks: systems, lengths, and episodes whose seeds never meet."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from trajlearn import Cartpole, Quadrotor, Reacher, TrajectoryDataset
from trajlearn.envs.base import Environment

N_EPISODES = 100


class Task(NamedTuple):
    """Steps of a training episode, and of a test episode that goes on beyond."""

    length: int
    test_length: int


#: Tasks of every benchmark.
TASKS = {"cartpole": Task(200, 400), "reacher": Task(500, 1000)}
#: The task with process noise, of the benchmark of errors by horizon alone.
QUADROTOR = {"quadrotor-sim": Task(500, 1000)}
# like the paper's code, cartpole and quadrotor draw episodes that end early again
_ENVIRONMENTS: dict[str, Callable[[], Environment]] = {
    "cartpole": partial(Cartpole, redraw_terminated=True),
    "reacher": Reacher,
    "quadrotor-sim": partial(Quadrotor, redraw_terminated=True),
}


def shape(task: str) -> Task:
    """Lengths of a task, by name."""
    return (TASKS | QUADROTOR)[task]


def environment(task: str) -> Environment:
    """The simulator of a task."""
    return _ENVIRONMENTS[task]()


def episodes(
    task: str, seed: int, *, n_test: int = N_EPISODES, test_length: int | None = None
) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes.

    The test episodes are as long as the training episodes, or as `test_length` says.
    """
    env, length = environment(task), shape(task).length
    train = env.collect(N_EPISODES, length, random_state=2 * seed)
    return train, env.collect(n_test, test_length or length, random_state=2 * seed + 1)
