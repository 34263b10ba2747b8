"""Episodes for the checks: damped oscillators under linear feedback, their gains as theta."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.trajectories import TrajectoryDataset

DT = 0.2


def oscillators(
    n: int, *, seed: int, irregular: bool = False, equal: bool = False
) -> TrajectoryDataset:
    """N short episodes of x'' = -x - 0.3 x' + a under a = -K s with a random gain K.

    Parameters
    ----------
    n : int
    seed : int
    irregular : bool, default=False
        Time steps between 0.06 and 0.34 instead of 0.2.
    equal : bool, default=False
        12 steps each instead of 6 to 12.
    """
    rng = np.random.default_rng(seed)
    lengths = np.full(n, 12) if equal else rng.integers(6, 13, size=n)
    lengths[0] = 12
    episodes = [_episode(rng, int(steps), irregular) for steps in lengths]
    fields: dict[str, Any] = {name: [e[name] for e in episodes] for name in episodes[0]}
    return TrajectoryDataset.from_arrays(
        **fields,
        group=[f"day {i % 4}" for i in range(n)],
        terminated=np.arange(n) % 5 == 4,
        state_names=["position", "velocity"],
    )


def _episode(rng: np.random.Generator, steps: int, irregular: bool) -> dict[str, Any]:
    gains, states = rng.uniform(0.2, 1.0, size=2), np.empty((steps + 1, 2))
    dt = rng.uniform(0.3, 1.7, size=steps) * DT if irregular else np.full(steps, DT)
    states[0], actions = rng.uniform(-1, 1, size=2), np.empty((steps, 1))
    for t in range(steps):
        position, velocity = states[t]
        actions[t] = -gains @ states[t]
        velocity = velocity + dt[t] * (-position - 0.3 * velocity + actions[t, 0])
        states[t + 1] = position + dt[t] * velocity, velocity
    return {
        "states": states,
        "actions": actions,
        "params": gains,
        "rewards": -(states[1:, 0] ** 2),
        "times": np.concatenate([[0.0], np.cumsum(dt)]),
    }


def with_garbage(
    ds: TrajectoryDataset, start: NDArray[np.intp], *, keep_actions: bool
) -> TrajectoryDataset:
    """The same episodes with everything measured after `start` (n,) overwritten."""
    rng = np.random.default_rng(99)
    episodes: list[Any] = list(ds)
    fields: dict[str, list[Any]] = {"states": [], "actions": [], "rewards": []}
    for episode, begin in zip(episodes, start):
        state_after = np.arange(episode.length + 1) > begin
        step_after = state_after[1:]
        noise = 1e3 * rng.normal(size=(episode.length + 1, 4))
        fields["states"].append(np.where(state_after[:, None], noise[:, :2], episode.states))
        fields["actions"].append(
            episode.actions
            if keep_actions
            else np.where(step_after[:, None], noise[1:, 2:3], episode.actions)
        )
        fields["rewards"].append(np.where(step_after, noise[1:, 3], episode.rewards))
    return rebuilt(ds, **fields, terminated=~ds.terminated)


def rebuilt(ds: TrajectoryDataset, **changes: Any) -> TrajectoryDataset:
    """The episodes with some fields changed; None drops one."""
    perhaps = ("actions", "params", "rewards")
    fields: dict[str, Any] = {
        name: [getattr(episode, name) for episode in ds] for name in ("states", "times", *perhaps)
    }
    fields |= {"group": ds.group, "terminated": ds.terminated, "ids": ds.ids} | changes
    if len(ds.state_names) == np.shape(fields["states"][0])[1]:
        fields["state_names"] = ds.state_names
    return TrajectoryDataset.from_arrays(**fields)
