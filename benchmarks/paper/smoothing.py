"""Does smoothing noisy states give back what noise takes from forecasts?

`KalmanSmoother` on simulated episodes whose measurement noise is known: 0, 1, 3 and 10 % of the
standard deviation of each state. First the error of the training states, raw, filtered and
smoothed, by state and smoother. Then forecasts of T, C (closed loop) and D with our settings,
trained on raw and on smoothed states, on cartpole and reacher. On cartpole a third training set,
the true states, shows what a perfect smoother would give. The errors of forecasts are against the
true test states; a forecast starts from the measured state, or the filter's estimate of it: the
first state of an episode, where the filter has one measurement, or state 20, where it has 21. The
simulated quadrotor, whose process noise no filter can tell from measurement noise, is there for
the states alone.

Whether velocity or acceleration drifts is chosen by the likelihood of other training episodes,
never by true states.
"""

import re
import warnings
from collections import Counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._models import build
from benchmarks.paper._rollouts import N_TEST, action_sources, expected_warnings, windows
from benchmarks.paper._smoothing_figures import draw
from benchmarks.paper._smoothing_page import LABELS, report
from benchmarks.paper._tasks import N_EPISODES, TASKS, environment, episodes, shape
from trajlearn import TrajectoryDataset, horizon_errors
from trajlearn.exceptions import SmoothingWarning
from trajlearn.trajectories.kalman import KalmanSmoother

NOISE = {"full": [0.0, 0.01, 0.03, 0.1], "quick": [0.0, 0.03]}
#: Tasks of the forecasts, and of the errors of states.
FORECAST = {"full": list(TASKS), "quick": ["cartpole"]}
STATES = {"full": [*TASKS, "quadrotor-sim"], "quick": ["cartpole"]}
MODELS = ["T", "C", "D"]
WINDOWS = ["short", "long"]
#: States that forecasts start from; the later one bounds what a filter has seen.
STARTS = [0, 20]
#: Measured velocities that one filter takes together with their positions.
VELOCITIES = {
    "cartpole": {"x": "x_dot", "theta": "theta_dot"},
    "reacher": {},
    "quadrotor-sim": {"roll": "wx", "pitch": "wy"},
}
#: Whether forecasts (and figures) use them. The quadrotor's are rates about its own axes and no
#: derivatives of angles with noise of their own: the smoother warns.
FUSED = {"cartpole": True, "reacher": False, "quadrotor-sim": False}
# episodes of no other seed, and their noise, for the choice of the smoother's model
CHOICE_SEED, CHOICE_NOISE = 50, 0.03


# -- data and smoothers -------------------------------------------------------------------


def measured(
    task: str, noise: float, seed: int, *, mode: str
) -> tuple[TrajectoryDataset, TrajectoryDataset, TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes: the true ones, then the same with noise."""
    length = shape(task).length + max(STARTS)
    train, test = episodes(task, seed, n_test=N_TEST[mode], test_length=length)
    noisy = [
        some.add_noise(noise, random_state=_noise_seed(seed) + k)
        for k, some in enumerate((train, test))
    ]
    return train, test, *noisy


def _noise_seed(seed: int) -> int:
    """Of the training episodes; the next number is that of the test episodes."""
    return 1000 + 2 * seed


def smoother(task: str, model: str, fused: bool) -> KalmanSmoother:
    """A smoother of all states."""
    return KalmanSmoother(model, velocities=VELOCITIES[task] if fused else None)


def fitted(
    estimator: KalmanSmoother, noisy: TrajectoryDataset
) -> tuple[TrajectoryDataset, list[str]]:
    """Smoothed training episodes, and the texts of the smoother's warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        smooth = estimator.fit_transform(noisy)
    return smooth, [str(w.message) for w in caught if issubclass(w.category, SmoothingWarning)]


def state_errors(
    estimator: KalmanSmoother,
    true: TrajectoryDataset,
    noisy: TrajectoryDataset,
    smooth: TrajectoryDataset,
    texts: list[str],
) -> dict[str, Any]:
    """Root mean square errors by state in its standard deviations, and the noise as estimated."""
    std = true.states.std(axis=0)

    def error(some: TrajectoryDataset) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.mean((some.states - true.states) ** 2, axis=0)) / std)

    names = true.state_names
    estimated = np.array([estimator.measurement_noise_[name] for name in names])
    return {
        "state": list(names),
        "raw": error(noisy),
        "filtered": error(estimator.transform(noisy)),
        "smoothed": error(smooth),
        "estimated_noise": estimated / std,
        "warned": [any(re.search(rf"\b{name}\b", text) for text in texts) for name in names],
    }


# -- cells --------------------------------------------------------------------------------


def choice_cell(task: str, fused: bool, noise: float, seed: int) -> dict[str, str]:
    """The likelier model of motion of each filter, by name of its (position) state."""
    train, _ = episodes(task, seed, n_test=1, test_length=1)
    estimator = smoother(task, "auto", fused)
    fitted(estimator, train.add_noise(noise, random_state=_noise_seed(seed)))
    return estimator.models_


def state_cell(task: str, noise: float, model: str, fused: bool, seed: int) -> dict[str, Any]:
    """Errors of the training states with one smoother."""
    true, _ = episodes(task, seed, n_test=1, test_length=1)
    noisy = true.add_noise(noise, random_state=_noise_seed(seed))
    estimator = smoother(task, model, fused)
    return state_errors(estimator, true, noisy, *fitted(estimator, noisy))


def forecast_cell(
    task: str, noise: float, states: str, model: str | None, fused: bool, mode: str, seed: int
) -> dict[str, Any]:
    """All models on one training set: their errors, and those of the states they start from.

    Parameters
    ----------
    task : str
    noise : float
        In standard deviations of each state.
    states : {"raw", "smoothed", "true"}
        Of the training episodes. Behind "smoothed" forecasts start from filtered states, else
        from measured ones.
    model : str or None
        Of the smoother, where there is one.
    fused : bool
    mode : str
    seed : int
    """
    true, test, noisy, seen = measured(task, noise, seed, mode=mode)
    result: dict[str, Any] = {"states": None}
    train = {"raw": noisy, "true": true}.get(states)
    if train is None:
        estimator = smoother(task, str(model), fused)
        train, texts = fitted(estimator, noisy)
        # what a pipeline does in predict
        seen = estimator.transform(seen)
        result["states"] = state_errors(estimator, true, noisy, train, texts)
    spread = true.states.std(axis=0)
    result["starts"] = {
        start: np.sqrt(np.mean(((_at(seen, start) - _at(test, start)) / spread) ** 2))
        for start in STARTS
    }
    extent = np.stack([true.states.min(axis=0), true.states.max(axis=0)])
    policy = environment(task).policy
    result["errors"] = []
    for name in MODELS:
        learner = build(name, "default", policy=policy, mode=mode, seed=seed).fit(train)
        for actions in action_sources(name):
            asked = {} if actions == "none" else {"actions": actions}
            for start in STARTS:
                errors = _forecast_errors(
                    learner, seen, test, extent, start=start, horizon=shape(task).length, **asked
                )
                key = {"model": name, "actions": actions, "start": start}
                result["errors"] += [key | line for line in errors]
    return result


def _at(ds: TrajectoryDataset, index: int) -> NDArray[np.float64]:
    """The state of this index of each episode."""
    return ds.states[ds.offsets[:-1] + index]


def _forecast_errors(
    learner: Any,
    seen: TrajectoryDataset,
    true: TrajectoryDataset,
    extent: NDArray[np.float64],
    **asked: Any,
) -> list[dict[str, Any]]:
    """Errors in the windows of horizons, summed up over episodes."""
    with expected_warnings():
        forecast = learner.predict(seen, **asked)
    # the same unit for all: noise widens the range of the states in training
    forecast.state_range = extent
    values = horizon_errors(forecast, true, truth_kind="true").to_numpy()
    lines = []
    for window in WINDOWS:
        means = values[:, windows(values.shape[1])[window]].mean(axis=1)
        line = {"window": window, "median": np.median(means), "mean": means.mean()}
        lines.append(line | {"n_diverged": int(np.isinf(means).sum()), "n_episodes": len(means)})
    return lines


# -- all cells ----------------------------------------------------------------------------


def run(run: Run) -> Tables:
    """Errors of states and of forecasts."""
    tasks, mode = STATES[run.mode], run.mode
    choice = _choice(run, tasks)
    chosen = {
        str(task): Counter(some["model"]).most_common(1)[0][0]
        for task, some in choice.groupby("task")
    }
    forecasts = _forecast_cells(run, chosen)
    done = {(cell["task"], cell["model"], cell["fused"]) for cell in forecasts if cell["model"]}
    states = [
        {"task": task, "noise": noise, "model": model, "fused": fused, "seed": seed}
        for task in tasks
        for fused in ([False, True] if VELOCITIES[task] else [False])
        for model in ("velocity", "acceleration")
        for noise in NOISE[mode]
        for seed in run.seeds
        # smoothed for a forecast anyway
        if (task, model, fused) not in done
    ]
    results = list(zip(forecasts, run.cells(forecasts, forecast_cell), strict=True))
    lines = [(cell, result["states"]) for cell, result in results if result["states"]]
    lines += list(zip(states, run.cells(states, state_cell), strict=True))
    by_state = [pd.DataFrame(_key(cell, chosen) | result) for cell, result in lines]
    by_window, starts = [], []
    for cell, result in results:
        key = {name: cell[name] for name in ("task", "noise", "states", "seed")}
        by_window.append(pd.DataFrame([key | line for line in result["errors"]]))
        starts += [key | {"start": int(s), "error": e} for s, e in result["starts"].items()]
    return {
        "choice": choice,
        "states": pd.concat(by_state, ignore_index=True),
        "starts": pd.DataFrame(starts),
        "errors": pd.concat(by_window, ignore_index=True),
    }


def _choice(run: Run, tasks: list[str]) -> pd.DataFrame:
    """What the likelihood prefers: a line a filter."""
    cells = [
        {"task": task, "fused": FUSED[task], "noise": CHOICE_NOISE, "seed": CHOICE_SEED}
        for task in tasks
    ]
    return pd.DataFrame(
        [
            {"task": cell["task"], "filter": name, "model": model}
            for cell, models in zip(cells, run.cells(cells, choice_cell), strict=True)
            for name, model in models.items()
        ]
    )


def _forecast_cells(run: Run, chosen: dict[str, str]) -> list[dict[str, Any]]:
    return [
        {
            "task": task,
            "noise": noise,
            "states": states,
            "model": chosen[task] if states == "smoothed" else None,
            "fused": FUSED[task] and states == "smoothed",
            "mode": run.mode,
            "seed": seed,
        }
        for task in FORECAST[run.mode]
        for noise in NOISE[run.mode]
        for states in LABELS
        for seed in run.seeds
        # without noise raw states are the true ones; on the reacher they cost too much time
        if states != "true" or (noise > 0 and task == "cartpole")
    ]


def _key(cell: dict[str, Any], chosen: dict[str, str]) -> dict[str, Any]:
    """Which smoother, and whether it is the one of the forecasts."""
    task, model, fused = cell["task"], cell["model"], cell["fused"]
    name = model + (", fused" if fused else "")
    used = model == chosen[task] and fused == FUSED[task]
    return {"task": task, "noise": cell["noise"], "smoother": name, "used": used} | {
        "seed": cell["seed"]
    }


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "models": MODELS,
        "noise": NOISE[mode],
        "starts": STARTS,
        "velocities": VELOCITIES,
        "fused": FUSED,
        "choice": {"seed": CHOICE_SEED, "noise": CHOICE_NOISE},
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "tasks": {task: shape(task) for task in STATES[mode]},
    }


BENCHMARK = Benchmark("smoothing", __doc__, run, report, draw, settings, minutes=15)

if __name__ == "__main__":
    BENCHMARK.main()
