"""The paper's simulated tasks: systems, lengths, and episodes whose seeds never meet."""

from typing import NamedTuple

from trajlearn import Cartpole, Reacher, TrajectoryDataset
from trajlearn.envs.base import Environment

N_EPISODES = 100


class Task(NamedTuple):
    """Steps of a training episode, and of a test episode that goes on beyond."""

    length: int
    test_length: int


TASKS = {"cartpole": Task(200, 400), "reacher": Task(500, 1000)}


def environment(task: str) -> Environment:
    """The simulator of a task; like the paper, cartpole redraws episodes that end early."""
    return Cartpole(redraw_terminated=True) if task == "cartpole" else Reacher()


def episodes(
    task: str, seed: int, *, n_test: int = N_EPISODES, test_length: int | None = None
) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes.

    The test episodes are as long as the training episodes, or as `test_length` says.
    """
    env, length = environment(task), TASKS[task].length
    train = env.collect(N_EPISODES, length, random_state=2 * seed)
    return train, env.collect(n_test, test_length or length, random_state=2 * seed + 1)
