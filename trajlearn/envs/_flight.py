"""Flying a batch of episodes step by step, each to its own end."""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from trajlearn.policies import Policy

if TYPE_CHECKING:
    from trajlearn.envs.base import Environment

__all__ = ["Episode", "SimulationError", "Simulator", "fly", "fly_parallel"]


class Episode(NamedTuple):
    """What one flight gave, from the reset state to the end."""

    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    params: NDArray[np.float64]
    terminated: bool


class Simulator(Protocol):
    """What advances the episodes of one batch: see ``Environment._simulator``."""

    def __call__(
        self,
        rows: NDArray[np.intp],
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        /,
    ) -> NDArray[np.float64]: ...


class SimulationError(ValueError):
    """A step that went wrong: in which row of the states, and how ("... left the bounds")."""

    def __init__(self, row: int, reason: str) -> None:
        super().__init__(row, reason)
        self.row = row
        self.reason = reason

    def __str__(self) -> str:
        return f"the simulation of row {self.row} of the states {self.reason}."


def fly_parallel(
    env: "Environment",
    starts: NDArray[np.float64],
    params: NDArray[np.float64],
    length: int,
    policy: Policy,
    numbers: Sequence[int],
    noise: Sequence[Generator],
    n_jobs: int | None,
) -> list[Episode]:
    """Share the episodes among joblib's workers, a stretch each."""
    from joblib import Parallel, delayed, effective_n_jobs

    n_workers = min(effective_n_jobs(n_jobs), len(starts))
    if n_workers == 1:
        return fly(env, starts, params, length, policy, numbers, noise)
    edges = np.linspace(0, len(starts), n_workers + 1).astype(int).tolist()
    shares = [slice(a, b) for a, b in pairwise(edges)]
    parts = Parallel(n_jobs=n_jobs)(
        delayed(fly)(env, starts[part], params[part], length, policy, numbers[part], noise[part])
        for part in shares
    )
    return [episode for part in parts for episode in part]


def fly(
    env: "Environment",
    starts: NDArray[np.float64],
    params: NDArray[np.float64],
    length: int,
    policy: Policy,
    numbers: Sequence[int],
    noise: Sequence[Generator],
) -> list[Episode]:
    """Step all episodes at once, dropping each from the batch when it ends.

    ``numbers`` are the names of the episodes in messages, ``noise`` their generators.
    """
    n = len(starts)
    states = np.empty((n, length + 1, len(env.state_names)))
    actions = np.empty((n, length, len(env.action_names)))
    lengths = np.full(n, length)
    terminated = np.zeros(n, dtype=bool)
    states[:, 0] = current = starts
    flying, gains = np.arange(n), params
    advance = env._simulator(starts)
    for t in range(length):
        times = np.full(len(flying), t * env.dt)
        wanted = policy(current, gains, times)
        applied = env._clipped(wanted, len(flying), f"the policy's actions at step {t}")
        try:
            current = advance(flying, current, applied)
            current = env._disturbed(current, [noise[i] for i in flying.tolist()])
            if not np.isfinite(current).all():
                row = int(np.argwhere(~np.isfinite(current))[0, 0])
                raise SimulationError(row, "left the finite numbers")
        except SimulationError as error:
            number, theta = numbers[flying[error.row]], gains[error.row].tolist()
            raise ValueError(
                f"the simulation of episode {number} {error.reason} at step {t}: the step "
                f"dt={env.dt} is too long for the params {theta}, or the initial state is "
                "too large."
            ) from error
        actions[flying, t] = applied
        states[flying, t + 1] = current
        ended = env.is_terminal(current)
        if ended.any():
            lengths[flying[ended]] = t + 1
            terminated[flying[ended]] = True
            flying, current, gains = flying[~ended], current[~ended], gains[~ended]
            if not len(flying):
                break
    return [
        Episode(states[i, : steps + 1], actions[i, :steps], params[i], bool(terminated[i]))
        for i, steps in enumerate(lengths)
    ]
