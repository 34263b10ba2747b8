"""One fitted model on test episodes that go on beyond training: errors by horizon, by episode.

The cell that most figures share. It keeps the whole curve at some sixty horizons, and for every
test episode the mean error over a few windows of horizons, which is what an interval needs.
"""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Run
from benchmarks.paper._models import build, label
from benchmarks.paper._tasks import N_EPISODES, environment, episodes, shape
from trajlearn import TrajectoryDataset, horizon_errors, summarise
from trajlearn.exceptions import DivergenceWarning, HorizonWarning

#: Test episodes, full and quick.
N_TEST = {"full": N_EPISODES, "quick": 20}
#: Times the error of T that the paper prints for the others, with logged actions, beyond 50 steps.
PRINTED_GAIN = (5, 10)
_CURVE = ["median", "mean", "q65", "q95", "n_diverged"]


def windows(length: int) -> dict[str, slice]:
    """Horizons over which errors are averaged, for episodes of training of some length."""
    return {
        "within": slice(0, length),
        "short": slice(0, 25),
        "long": slice(50, length),
        "beyond": slice(length, None),
    }


def shown_horizons(test_length: int) -> NDArray[np.intp]:
    """Horizons of a curve: every one at first, then about evenly on a linear axis."""
    early = [*range(1, 11), 15, 20, 25, 30, 40]
    return np.unique(np.r_[early, np.linspace(50, test_length, 45).astype(int)])


def assess(
    model: Any, test: TrajectoryDataset, *, length: int, reward: Any = None, **forecast: Any
) -> dict[str, Any]:
    """Errors of a fitted model from the start of test episodes.

    Parameters
    ----------
    model : dynamics estimator
    test : TrajectoryDataset
        Episodes of one length, at least `length`.
    length : int
        Steps of the training episodes.
    reward : callable, optional
        For the error of the mean reward over the first `length` steps.
    **forecast
        Arguments of ``predict``, such as ``actions="logged"``.

    Returns
    -------
    dict
        ``curve`` (lists by `shown_horizons`), ``windows`` (mean error of each episode),
        ``reward`` (predicted minus true, by episode), ``seconds``.
    """
    began = time.perf_counter()
    with expected_warnings():
        predicted = model.predict(test, **forecast)
    seconds = time.perf_counter() - began
    errors = horizon_errors(predicted, test, truth_kind="true")
    test_length = errors.shape[1]
    curve = summarise(errors).loc[shown_horizons(test_length)]
    values = errors.to_numpy()
    result: dict[str, Any] = {
        "curve": {"horizon": curve.index.tolist()} | {k: curve[k].tolist() for k in _CURVE},
        "windows": {
            name: values[:, where].mean(axis=1).tolist()
            for name, where in windows(length).items()
            if values[:, where].size
        },
        "seconds": seconds,
    }
    if reward is not None:
        first = test.truncate(length)
        with expected_warnings():
            guess = model.predict_reward(first, reward, **forecast)
        truth = np.array([reward(episode.states[1:]).mean() for episode in first])
        result["reward"] = (guess - truth).tolist()
    return result


@contextmanager
def expected_warnings() -> Iterator[None]:
    """No warnings of what the tables report: divergence, and horizons beyond training."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        warnings.simplefilter("ignore", HorizonWarning)
        yield


def action_sources(model: str) -> list[str]:
    """Where the roll-outs of a model take their actions from, each worth a line of its own."""
    trajectory = model.startswith("T") or model == "C"
    return ["none"] if trajectory else ["logged", "policy"]


def cell(task: str, model: str, settings: str, mode: str, seed: int) -> dict[str, Any]:
    """Fit one model on one seed, and assess it with every source of actions."""
    env, (length, test_length) = environment(task), shape(task)
    train, test = episodes(task, seed, n_test=N_TEST[mode], test_length=test_length)
    estimator = build(model, settings, policy=env.policy, mode=mode, seed=seed)
    began = time.perf_counter()
    estimator.fit(train)
    seconds = time.perf_counter() - began
    results = {}
    for actions in action_sources(model):
        asked = {} if actions == "none" else {"actions": actions}
        results[actions] = assess(estimator, test, length=length, reward=env.reward, **asked)
    return {"fit_seconds": seconds, "actions": results}


def measure(run: Run, tasks: list[str], models: list[tuple[str, str]]) -> dict[str, pd.DataFrame]:
    """Tables of (model, settings) pairs on tasks, every fit at most once for all benchmarks.

    Returns
    -------
    dict of DataFrame
        ``curves``: a line a task, model, settings, actions, seed and horizon;
        ``episodes``: a line a test episode, its mean error in each window and its reward error.
    """
    cells = [
        {"task": task, "model": model, "settings": settings, "mode": run.mode, "seed": seed}
        for task in tasks
        for model, settings in models
        for seed in run.seeds
    ]
    curves, by_episode = [], []
    for asked, result in zip(cells, run.cells(cells, cell, shared="rollouts"), strict=True):
        for actions, some in result["actions"].items():
            key = {
                "task": asked["task"],
                "model": label(asked["model"], asked["settings"]),
                "actions": actions,
                "seed": asked["seed"],
            }
            curves.append(pd.DataFrame(key | some["curve"]))
            lines = {"episode": range(len(some["reward"]))} | some["windows"]
            by_episode.append(pd.DataFrame(key | lines | {"reward": some["reward"]}))
    return {
        "curves": pd.concat(curves, ignore_index=True),
        "episodes": pd.concat(by_episode, ignore_index=True),
    }
