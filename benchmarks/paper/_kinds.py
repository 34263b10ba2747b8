"""Kinds of cartpole episodes, by their gains and by what happens to those that end early."""

import warnings
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._tasks import TASKS
from trajlearn import Cartpole, TrajectoryDataset, horizon_errors, summarise
from trajlearn.exceptions import DivergenceWarning, HorizonWarning

Floats = NDArray[np.float64]

KINDS: dict[str, dict[str, Any]] = {
    "stable": {"gains": "stable", "redraw_terminated": True},
    "periodic": {"gains": "periodic", "redraw_terminated": True},
    "unstable": {"gains": "unstable", "limit_scale": float("inf")},
    "survivors": {"gains": "unstable", "redraw_terminated": True},
    "ended": {"gains": "unstable"},
}
LENGTH = TASKS["cartpole"].length
#: Horizons of the stored curves.
HORIZONS = [1, 2, 3, 5, 7, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100, 120, 140, 160, 180, 200]
#: Horizons over which the errors of an episode are averaged: from 6 to 25, and beyond 50.
WINDOWS = {"short": slice(5, 25), "long": slice(50, LENGTH)}


def environment(kind: str) -> Cartpole:
    """The cartpole that gives one kind of episodes."""
    return Cartpole(**KINDS[kind])


def episodes(
    kind: str, seed: int, n_train: int, n_test: int
) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes; no start of training is in the test set of any kind."""
    env = environment(kind)
    train = env.collect(n_train, LENGTH, random_state=2 * seed)
    return train, env.collect(n_test, LENGTH, random_state=2 * seed + 1)


def state_range(ds: TrajectoryDataset) -> Floats:
    """Least and greatest states (2, d_s)."""
    return np.stack([ds.states.min(axis=0), ds.states.max(axis=0)])


def errors_of(model: Any, test: TrajectoryDataset, scale: Floats, **forecast: Any) -> pd.DataFrame:
    """Errors (n, H) on a scale that need not be the training range of the model."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        warnings.simplefilter("ignore", HorizonWarning)
        predicted = model.predict(test, **forecast)
    # what errors are normalised by
    predicted.state_range = scale
    return horizon_errors(predicted, test, truth_kind="true")


def errors_of_holding(test: TrajectoryDataset, scale: Floats) -> pd.DataFrame:
    """Errors (n, H) of predicting that nothing moves: what a useful model must beat."""
    errors = np.full((len(test), test.lengths.max()), np.nan)
    for row, episode in zip(errors, test, strict=True):
        off = (episode.states[1:] - episode.states[0]) / (scale[1] - scale[0])
        row[: episode.length] = (off**2).mean(axis=1)
    return pd.DataFrame(errors, columns=range(1, errors.shape[1] + 1))


def assess(errors: pd.DataFrame) -> dict[str, Any]:
    """Median by horizon and by window of the errors (n, H).

    An episode counts where it has steps: ``n_long`` are those with steps in the long window.
    ``n_diverged`` in ``windows`` are episodes whose forecast diverges at any step.
    """
    curve = summarise(errors).reindex([h for h in HORIZONS if h in errors])
    values = errors.to_numpy()
    means = pd.DataFrame({name: _mean_step(values[:, at]) for name, at in WINDOWS.items()})
    windows = summarise(means)
    return {
        "curve": {"horizon": curve.index.tolist()}
        | {name: curve[name].tolist() for name in ("median", "n_episodes", "n_diverged")},
        "windows": windows["median"].to_dict()
        | {f"n_{name}": int(n) for name, n in windows["n_episodes"].items()}
        | {"n_episodes": len(values), "n_diverged": int(np.isinf(values).any(axis=1).sum())},
    }


def _mean_step(values: Floats) -> Floats:
    """Mean of each row over the steps that there are; NaN without any."""
    present = ~np.isnan(values)
    total, count = np.where(present, values, 0.0).sum(axis=1), present.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def swings(theta: Floats, *, least: float = 0.01, times: int = 3) -> bool:
    """Whether an angle goes to and fro: so many changes of side by more than `least` rad."""
    sides = np.sign(theta[np.abs(theta) > least])
    return int((np.diff(sides) != 0).sum()) >= times


def facts(train: TrajectoryDataset, test: TrajectoryDataset) -> dict[str, float]:
    """What a kind is like: training steps, ranges of the states, share of swinging episodes."""
    low, high = state_range(train)
    return {
        "training_steps": int(train.lengths.sum()),
        **{f"range_{name}": high[i] - low[i] for i, name in enumerate(train.state_names)},
        "swinging": float(np.mean([swings(episode.states[:, 2]) for episode in test])),
    }


def example(test: TrajectoryDataset) -> pd.DataFrame:
    """Cart and pole in the episode of ten steps or more whose cart goes as far as the median."""
    some = [episode for episode in test if episode.length >= min(10, test.lengths.max())]
    some.sort(key=lambda episode: float(np.abs(episode.states[:, 0]).max()))
    states = some[len(some) // 2].states
    return pd.DataFrame({"step": range(len(states)), "x": states[:, 0], "theta": states[:, 2]})
