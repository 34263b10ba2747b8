"""Models of logs that keep some control steps only, asked for the steps that were left out.

Predicted states are arrays (n, length + 1, d_s) over all control steps, the known start first,
NaN where nothing was asked and infinite where a forecast has diverged.
"""

import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from benchmarks.paper._models import build
from benchmarks.paper._rollouts import N_TEST
from benchmarks.paper._tasks import TASKS, environment, episodes
from trajlearn import TrajectoryDataset, summarise
from trajlearn.exceptions import DivergenceWarning

#: Longest gap of an irregular log, in mean gaps.
LONGEST_GAP = 2.5
#: Times that test episodes are asked for.
ASKED = ["every step", "irregular", "twice the rate", "grid"]
#: Where errors are told apart by the distance from the nearest grid time: up to which interval.
PARTS = {"interval 1": 1, "intervals 2 to 5": 5, "later": None}

Floats = NDArray[np.float64]
#: Control steps of every episode, in order; 0 is the first.
Steps = Sequence[NDArray[np.intp]]


class System(NamedTuple):
    """What is fitted: a model, its settings, and the log it learns from."""

    model: str
    settings: str
    log: str


# -- logs and predictions -----------------------------------------------------------------


def irregular_steps(n: int, length: int, interval: int, rng: np.random.Generator) -> Steps:
    """Logged steps of n episodes, the first and the last among them.

    The gaps are geometric, cut at `LONGEST_GAP` mean gaps, given that they add up to `length`:
    every episode keeps ``length / interval + 1`` states, as on a regular grid.
    """
    gaps = np.arange(1, int(LONGEST_GAP * interval) + 1)
    q = brentq(lambda q: np.average(gaps, weights=q**gaps) - interval, 0.1, 1.0)
    chance = q**gaps / (q**gaps).sum()
    chosen: list[NDArray[np.intp]] = []
    while len(chosen) < n:
        drawn = rng.choice(gaps, p=chance, size=(5_000, length // interval))
        chosen.extend(drawn[drawn.sum(axis=1) == length])
    return [np.r_[0, np.cumsum(own)] for own in chosen[:n]]


def logged_at(ds: TrajectoryDataset, steps: Steps) -> TrajectoryDataset:
    """Episodes as if logged at some steps only: the states, and the actions applied there."""
    kept = list(zip(ds, steps, strict=True))
    return TrajectoryDataset.from_arrays(
        [episode.states[own] for episode, own in kept],
        actions=[episode.actions[own[:-1]] for episode, own in kept],
        params=ds.params,
        times=[episode.times[own] for episode, own in kept],
        **ds.names,
    )


def predicted(model: Any, test: TrajectoryDataset, steps: Steps, actions: str) -> Floats:
    """Predictions at some steps, from the first state of episodes of one length."""
    path = np.full((len(test), int(test.lengths[0]) + 1, test.states.shape[1]), np.nan)
    path[:, 0] = test.states[test.offsets[:-1]]
    asked = {} if actions == "none" else {"actions": actions}
    with warnings.catch_warnings():
        # the tables count divergence
        warnings.simplefilter("ignore", DivergenceWarning)
        means = model.predict(logged_at(test, steps), **asked).mean
    for whole, own, mean in zip(path, steps, means, strict=True):
        whole[own[1:]] = mean
    return path


def with_long_steps(model: Any, test: TrajectoryDataset, interval: int, actions: str) -> Floats:
    """Predictions at every step: a first step of 1, 2, ..., `interval`, then `interval` each."""
    length = int(test.lengths[0])
    path: Floats | None = None
    for first in range(1, interval + 1):
        steps = np.r_[0, np.arange(first, length + 1, interval)]
        part = predicted(model, test, [steps] * len(test), actions)
        path = part if path is None else np.where(np.isnan(path), part, path)
    assert path is not None
    return path


def only_at(path: Floats, steps: Steps) -> Floats:
    """The same predictions, NaN at other steps."""
    out = np.full_like(path, np.nan)
    for whole, own, values in zip(out, steps, path, strict=True):
        whole[own] = values[own]
    return out


def straight_lines(path: Floats, interval: int) -> Floats:
    """Every step by linear interpolation of the states at multiples of `interval`."""
    grid = path[:, ::interval]
    at = np.arange(path.shape[1])
    left = np.minimum(at // interval, grid.shape[1] - 2)
    share = ((at - left * interval) / interval)[:, None]
    with np.errstate(invalid="ignore"):
        between = (1 - share) * grid[:, left] + share * grid[:, left + 1]
    # a line towards a diverged state has diverged; the states on the grid stay as they are
    between = np.where(np.isfinite(between), between, np.inf)
    between[:, ::interval] = grid
    return between


def cubic(path: Floats, interval: int) -> Floats:
    """As `straight_lines`, by cubic splines; for finite states."""
    at = np.arange(path.shape[1])
    spline = CubicSpline(at[::interval], path[:, ::interval], axis=1)(at)
    spline[:, ::interval] = path[:, ::interval]
    return np.asarray(spline)


def grid_distances(length: int, interval: int) -> NDArray[np.intp]:
    """Control steps from each of the steps 1, ..., length to the nearest multiple of `interval`."""
    after = np.arange(1, length + 1) % interval
    return np.minimum(after, interval - after)


# -- one fit ------------------------------------------------------------------------------


def cell(
    task: str, model: str, settings: str, log: str, interval: int, mode: str, seed: int
) -> list[dict[str, Any]]:
    """Fit a model on a log and ask it for every kind of times.

    Returns
    -------
    list of dict
        One a source of actions and a way. Statistics over test episodes of the mean error over
        the times asked for, of that in each mean interval, and by the distance from the grid.
    """
    env, system = environment(task), System(model, settings, log)
    train, test = episodes(task, seed, n_test=N_TEST[mode])
    fitted = None
    if model != "true states":
        fitted = _estimator(system, env.policy, mode, seed).fit(thinned(train, log, interval, seed))
    length = TASKS[task].length
    truth = test.states.reshape(len(test), length + 1, -1)
    # one unit for every log: the range of what there was to log
    width = np.ptp(train.states, axis=0)
    ends = range(interval, length + 1, interval)
    results = []
    for actions, way, paths in ways(system, fitted, test, interval, seed):
        errors = {k: (((v - truth) / width) ** 2).mean(axis=2)[:, 1:] for k, v in paths.items()}
        whole = errors["every step"]
        curve = {end: whole[:, end - interval : end].mean(axis=1) for end in ends}
        results.append(
            {
                "actions": actions,
                "way": way,
                "asked": _over_episodes({k: np.nanmean(v, axis=1) for k, v in errors.items()}),
                "curve": _over_episodes(curve),
                "distance": _over_episodes(by_distance(whole, interval)),
            }
        )
    return results


def thinned(ds: TrajectoryDataset, log: str, interval: int, seed: int) -> TrajectoryDataset:
    """What a log keeps of training episodes."""
    if log == "full":
        return ds
    if log == "regular":
        return ds.decimate(interval)
    rng = np.random.default_rng([seed, interval, 0])
    return logged_at(ds, irregular_steps(len(ds), int(ds.lengths[0]), interval, rng))


def _estimator(system: System, policy: Any, mode: str, seed: int) -> Any:
    name = system.model.removesuffix(" with dt")
    estimator = build(name, system.settings, policy=policy, mode=mode, seed=seed)
    if name != system.model:
        estimator.set_params(inputs=["state", "params" if name == "C" else "action", "dt"])
    return estimator


def asked_steps(n: int, length: int, interval: int, seed: int) -> dict[str, Steps]:
    """Control steps at which n test episodes are asked for, the known start first."""

    def every(k: int) -> Steps:
        return [np.arange(0, length + 1, k)] * n

    # not the stream of the training log
    fresh = irregular_steps(n, length, interval, np.random.default_rng([seed, interval, 1]))
    return dict(zip(ASKED, (every(1), fresh, every(interval // 2), every(interval)), strict=True))


def ways(
    system: System, model: Any, test: TrajectoryDataset, interval: int, seed: int
) -> Iterator[tuple[str, str, dict[str, Floats]]]:
    """Source of actions, way and predicted states by what was asked: all a system can do."""
    asked = asked_steps(len(test), int(test.lengths[0]), interval, seed)

    def parts(path: Floats) -> dict[str, Floats]:
        return {name: only_at(path, steps) for name, steps in asked.items()}

    if system.model == "true states":
        truth = test.states.reshape(len(test), -1, test.states.shape[1])
        yield "none", "linear", parts(straight_lines(truth, interval))
        yield "none", "cubic", parts(cubic(truth, interval))
        return
    for actions in ["policy", "logged"] if system.model.startswith("D") else ["none"]:
        at = {"test": test, "actions": actions}
        if system.model == "T" or system.log == "irregular":
            yield actions, "direct", {k: predicted(model, steps=v, **at) for k, v in asked.items()}
        elif system.log == "full":
            yield actions, "direct", parts(predicted(model, steps=asked["every step"], **at))
        if system.log == "regular":
            grid = predicted(model, steps=asked["grid"], **at)
            yield actions, "linear", parts(straight_lines(grid, interval))
        if system.model.endswith("with dt"):
            yield actions, "long steps", parts(with_long_steps(model, interval=interval, **at))


def by_distance(errors: Floats, interval: int) -> dict[str, Floats]:
    """Mean error of each episode by "part:distance", the distance in control steps."""
    length = errors.shape[1]
    distance, number = grid_distances(length, interval), np.arange(1, length + 1) // interval + 1
    found, begin = {}, 1
    for part, end in PARTS.items():
        inside = (number >= begin) & (number <= (end or length))
        for d in np.unique(distance[inside]):
            found[f"{part}:{d}"] = errors[:, inside & (distance == d)].mean(axis=1)
        begin = (end or length) + 1
    return found


def _over_episodes(values: dict[Any, Floats]) -> dict[str, list[Any]]:
    found = summarise(pd.DataFrame(values))
    statistics = {name: found[name].tolist() for name in ("median", "mean", "q95", "n_diverged")}
    return {"of": found.index.tolist(), **statistics}
