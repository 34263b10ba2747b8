"""The same episodes at another sampling time."""

from dataclasses import replace
from numbers import Integral, Real

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_scalar

from trajlearn.trajectories._columns import Columns, _offsets, runs
from trajlearn.trajectories._pieces import constant_stretches, like, theta_changes
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["decimate", "resample"]

# How far, in new steps, a time may be off the grid and still count as on it.
_SNAP = 1e-6


def decimate(ds: TrajectoryDataset, k: int) -> TrajectoryDataset:
    """As if logged `k` times slower: every k-th state, and the action applied there.

    Rewards are averaged over the `k` steps that one new step replaces, so that a reward stays
    a reward per step. Up to ``k - 1`` steps at the end are left out; `terminated` is kept,
    because the episode still ended by itself.

    A new step never spans a change of theta. Where one would, the episode is split at all its
    changes first, and stretches of less than `k` steps are left out; all episodes are then
    called ``"<id>:<start>"``, and the group (the id, if there was none) keeps them together.

    Parameters
    ----------
    ds : TrajectoryDataset
    k : int

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    InvalidEpisodeError
        If nothing would be left of an episode.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays(
    ...     [[[0.0], [1.0], [2.0], [3.0], [4.0]]], actions=[[[10.0], [11.0], [12.0], [13.0]]]
    ... )
    >>> decimate(ds, 2)[0].actions.ravel()
    array([10., 12.])
    """
    check_scalar(k, "k", Integral, min_val=1)
    episode, change = theta_changes(ds)
    columns = constant_stretches(
        ds, np.unique(episode[change % k != 0]), lambda c: c.lengths >= k, f"{k} steps"
    )
    counts = columns.lengths // k
    states = runs(columns.offsets[:-1], counts + 1, k)
    steps = runs(columns.step_offsets[:-1], counts, k)
    rewards = columns.rewards
    if rewards is not None:
        rewards = rewards[steps[:, None] + np.arange(k)].mean(axis=1)
    references, observed = columns.references, columns.observed
    return like(
        ds,
        replace(
            _held(columns, steps),
            offsets=_offsets(counts + 1),
            states=columns.states[states],
            times=columns.times[states],
            references=None if references is None else references[states],
            observed=None if observed is None else observed[states],
            rewards=rewards,
        ),
    )


def resample(ds: TrajectoryDataset, dt: float) -> TrajectoryDataset:
    """Episodes on the uniform grid ``times[0] + j * dt``, up to the last time.

    States, `observed` and references are interpolated linearly; actions and theta are held (the
    value in force at the beginning of the new step). The reward of a new step is the mean of the
    rewards over its time, each held during its own step. Less than one `dt` at the end is left out;
    `terminated` is kept.

    A new step never spans a change of theta: an episode where one would is split at its
    changes, as in `decimate`, each stretch with a grid from its own beginning.

    Parameters
    ----------
    ds : TrajectoryDataset
    dt : float
        New time step, in the unit of `times`.

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    InvalidEpisodeError
        If nothing would be left of an episode.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[0.0], [1.0], [3.0]]], times=[[0.0, 1.0, 2.0]])
    >>> resample(ds, 0.5).states.ravel()
    array([0. , 0.5, 1. , 2. , 3. ])
    """
    check_scalar(dt, "dt", Real, min_val=0, include_boundaries="neither")
    if not np.isfinite(dt):
        raise ValueError(f"dt = {dt} must be finite.")
    episode, change = theta_changes(ds)
    grid = (ds.times[ds.offsets[episode] + change] - ds.times[ds.offsets[episode]]) / dt
    columns = constant_stretches(
        ds,
        np.unique(episode[np.abs(grid - np.round(grid)) > _SNAP]),
        lambda c: _new_steps(c, dt) > 0,
        f"dt = {dt:g}",
    )
    counts = _new_steps(columns, dt)
    position = runs(np.zeros_like(counts), counts + 1)
    times = np.repeat(columns.times[columns.offsets[:-1]], counts + 1) + position * dt
    offsets = _offsets(counts + 1)
    step = _step_in_force(columns, offsets, times, dt)
    row = step + np.repeat(columns.offsets[:-1], counts + 1)
    width = columns.times[row + 1] - columns.times[row]
    weight = np.clip((times - columns.times[row]) / width, 0.0, 1.0)

    def mix(values: NDArray[np.float64]) -> NDArray[np.float64]:
        # Convex combinations are exact at both ends and never outside of them.
        share = weight.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - share) * values[row] + share * values[row + 1]

    is_step = np.ones(len(times), dtype=bool)
    is_step[offsets[1:] - 1] = False
    held = (step + np.repeat(columns.step_offsets[:-1], counts + 1))[is_step]
    rewards, references, observed = columns.rewards, columns.references, columns.observed
    if rewards is not None:
        rewards = np.diff(mix(_integral(columns, rewards)))[is_step[:-1]] / dt
    return like(
        ds,
        replace(
            _held(columns, held),
            offsets=offsets,
            states=mix(columns.states),
            times=times,
            references=None if references is None else mix(references),
            observed=None if observed is None else mix(observed),
            rewards=rewards,
        ),
    )


def _held(columns: Columns, steps: NDArray[np.intp]) -> Columns:
    """Actions and theta in force at the beginning of the new steps."""
    actions, params = columns.actions, columns.params
    if params is not None and columns.params_per_step:
        params = params[steps]
    return replace(columns, actions=None if actions is None else actions[steps], params=params)


def _new_steps(columns: Columns, dt: float) -> NDArray[np.intp]:
    duration = columns.times[columns.offsets[1:] - 1] - columns.times[columns.offsets[:-1]]
    return np.floor(duration / dt + _SNAP).astype(np.intp)


def _step_in_force(
    columns: Columns, offsets: NDArray[np.intp], times: NDArray[np.float64], dt: float
) -> NDArray[np.intp]:
    """Index in its episode of the logged step in which each new time falls."""
    step = np.empty(len(times), dtype=np.intp)
    for i in range(columns.n_episodes):
        logged = columns.times[columns.offsets[i] : columns.offsets[i + 1] - 1]
        new = slice(offsets[i], offsets[i + 1])
        # Without the tolerance round-off would hold the previous action one step longer.
        step[new] = np.searchsorted(logged, times[new] + _SNAP * dt, side="right") - 1
    return step


def _integral(columns: Columns, rewards: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time integral of the held rewards from the start of each episode to each state."""
    total = np.zeros(len(columns.times))
    for i in range(columns.n_episodes):
        a, b = columns.offsets[i : i + 2]
        total[a + 1 : b] = np.cumsum(rewards[a - i : b - i - 1] * np.diff(columns.times[a:b]))
    return total
