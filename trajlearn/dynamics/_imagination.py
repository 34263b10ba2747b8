"""Episodes that a fitted model imagines: from known starts, under other theta."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import DivergenceWarning, HorizonWarning, SmoothingWarning
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import runs
from trajlearn.trajectories.times import episode_steps

__all__ = ["begun", "imagine", "together"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def _without_controls(ds: TrajectoryDataset) -> TrajectoryDataset:
    """The episodes as far as a model of states and theta knows them."""
    columns = replace(
        ds._columns, actions=None, rewards=None, observed=None, hindsight=False, group=None
    )
    names = ds._names | {"actions": (), "observed": ()}
    return TrajectoryDataset._of(columns, names)


def begun(
    ds: TrajectoryDataset, episode: Ints, theta: Floats, starts: Floats | None
) -> TrajectoryDataset:
    """Episodes that begin as those at `episode` (n,) do, under theta (n, p).

    With `starts` (n, d_s) they begin there, with the other signals of these episodes. Their later
    states are those logged, which a forecast does not read.
    """
    columns = _without_controls(ds)._columns.take(episode)
    states = columns.states
    if starts is not None:
        states = states.copy()
        states[columns.offsets[:-1]] = starts
    columns = replace(
        columns,
        states=states,
        params=theta,
        params_per_step=False,
        ids=np.arange(len(episode)),
        terminated=np.zeros(len(episode), dtype=bool),
    )
    return TrajectoryDataset._of(columns.freeze(), _without_controls(ds)._names)


def imagine(
    teacher: Any,
    ds: TrajectoryDataset,
    n_steps: int,
    limits: Floats,
    rng: np.random.Generator,
) -> TrajectoryDataset:
    """What a fitted model expects of `n_steps` of episodes that have begun.

    States are clipped to the `limits` (2, d_s): beyond them, far off is all that is known, and an
    episode that ended there would say nothing of its end. Nobody knows references after the log,
    nor when the next step is where steps vary; such episodes are not longer than the logged ones.
    """
    within_log = ds.references is not None or bool(np.isnan(episode_steps(ds)).any())
    reaches_beyond = n_steps > ds.lengths.min()
    with warnings.catch_warnings():
        # what diverges is clipped, and nothing is compared with these forecasts
        for category in (DivergenceWarning, HorizonWarning, SmoothingWarning):
            warnings.simplefilter("ignore", category)
        forecast = teacher.predict(
            ds,
            horizon=None if within_log and reaches_beyond else n_steps,
            actions="policy",
            random_state=int(rng.integers(2**31)),
        )
    steps = np.minimum(forecast.lengths, n_steps)
    known = _columns_of(ds.state_names, forecast.state_names, type(teacher).__name__)
    states = np.concatenate([forecast.initial_states[:, None], forecast.mean], axis=1)[..., known]
    times = np.concatenate([forecast.initial_times[:, None], forecast.times], axis=1)
    columns = ds._columns
    references = columns.references
    if references is not None:
        references = references[runs(columns.offsets[:-1], steps + 1)]
    rows = runs(np.arange(len(ds)) * states.shape[1], steps + 1)
    imagined = replace(
        columns,
        offsets=np.concatenate([[0], np.cumsum(steps + 1)]),
        states=_within(states, limits).reshape(-1, states.shape[2])[rows],
        times=times.ravel()[rows],
        references=references,
    )
    return TrajectoryDataset._of(imagined.freeze(), ds._names)


def _columns_of(names: tuple[str, ...], predicted: tuple[str, ...], teacher: str) -> list[int]:
    """Where the logged states are among those predicted, to which a smoother appends some."""
    if len(predicted) == len(names) and not set(predicted) & set(names):
        # a model that was fitted elsewhere, under other names
        return list(range(len(names)))
    if missing := [name for name in names if name not in predicted]:
        raise ValueError(
            f"the teacher ({teacher}) predicts the states {list(predicted)}, and an imagined "
            f"episode needs {missing}, too: let it predict all logged states."
        )
    return [predicted.index(name) for name in names]


def _within(states: Floats, limits: Floats) -> Floats:
    """States (n, H + 1, d_s) clipped to the limits; what has diverged is as it was before."""
    # one that has diverged tells no side
    finite = np.isfinite(states).all(axis=2)
    index = np.maximum.accumulate(np.where(finite, np.arange(states.shape[1]), 0), axis=1)
    return np.clip(np.take_along_axis(states, index[..., None], axis=1), *limits)


def together(ds: TrajectoryDataset, imagined: TrajectoryDataset) -> TrajectoryDataset:
    """Logged episodes followed by imagined ones, each of which is a group of its own."""
    logged = np.arange(len(ds)) if ds.group is None else ds.group
    label = np.unique(logged, return_inverse=True)[1]
    group = np.concatenate([label, label.max() + 1 + np.arange(len(imagined))])
    both = _without_controls(ds).concatenate(imagined)
    return TrajectoryDataset._of(replace(both._columns, group=group), both._names)
