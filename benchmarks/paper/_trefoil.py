"""The real quadrotor: errors by horizon on flights that no model was trained on.

The paper's hardware test is a Crazyflie under its default PID, one set of gains for all flights,
windows of 1,000 steps at 100 Hz; its models were tested on the windows that they were trained on.
Its flights are not public. Here three flights along one trefoil (`load_nanobench_trefoil`) are
held out in turn: a model is trained on the windows of two, and tested on those of the third.
"""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Run, Tables, data_folder
from benchmarks.paper._models import QUICK_STEPS, build, label
from benchmarks.paper._rollouts import expected_warnings, shown_horizons, windows
from trajlearn import (
    HoldForecaster,
    MeanEpisodeForecaster,
    OneStepRegressor,
    TrajectoryDataset,
    horizon_errors,
    load_nanobench_trefoil,
    summarise,
)

#: Folder of the flights.
DATA = "nanobench_trefoil"
LENGTH, STRIDE = 1000, 150
#: States that models have, and are scored on: the paper's five, as of the simulated quadrotor,
#: and all twelve, which alone say where on the trefoil the craft is.
STATES = {
    "attitude": ("roll", "pitch", "wx", "wy", "wz"),
    "all": ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "wx", "wy", "wz"),
}
#: Windows of horizons that are averaged, as everywhere, and steps between states of a picture.
WINDOWS = ["short", "long"]
SHOWN_EVERY = 5

BASELINES = ["hold", "mean flight"]
PAPER = ["D", "PE", "LSTM", "T"]
OURS = ["T", "T, no reference", "T, tracking error", "C", "D"]
#: Models of the picture, by name and settings.
PICTURED = [("D", "paper"), ("T", "paper"), ("T", "default")]


def models(states: str) -> list[tuple[str, str]]:
    """Models with their settings.

    A tracking error needs the position. PE and LSTM, which take longest, have only the states
    that the paper's have.
    """
    as_paper = PAPER if states == "attitude" else ["D", "T"]
    own = [m for m in OURS if states == "all" or m != "T, tracking error"]
    of = {"baseline": BASELINES, "paper": as_paper, "default": own}
    return [(model, settings) for settings, some in of.items() for model in some]


def flights() -> TrajectoryDataset:
    """Windows of the flights under the default PID; group: the flight."""
    ds = load_nanobench_trefoil(data_folder(DATA), controller="pid", window=None)
    # one controller: its name says nothing
    return ds.assign(context={}).window(LENGTH, stride=STRIDE)


def settings() -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {"models": {states: models(states) for states in STATES}} | {
        "states": STATES,
        "length": LENGTH,
        "stride": STRIDE,
    }


# -- cells --------------------------------------------------------------------------------


def cell(
    states: str, model: str, settings: str, flight: str, mode: str, seed: int
) -> dict[str, Any]:
    """Fit one model without one flight, and assess it on that flight.

    The paper's models and the baselines also on the windows of training, as the paper does.

    Returns
    -------
    dict
        ``tests``: for "held-out" (and "in-sample") the errors of each window up to the shown
        horizons (`between`) and the means over windows of horizons; ``predicted``: states every
        `SHOWN_EVERY` steps, of the models of the picture.
    """
    ds = flights().select_states(STATES[states])
    if settings != "default" or model == "T, no reference":
        # what the paper's models, and a forecast that nothing changes, know nothing of
        known = {} if model == "mean flight" else {"time_origin": None}
        ds = ds.assign(references=None, **known)
    held = np.asarray(ds.group) == flight
    train = ds[~held]
    estimator = estimator_of(model, settings, mode=mode, seed=seed).fit(train)
    result: dict[str, Any] = {"tests": {}}
    for name in ["held-out", *["in-sample"] * (settings != "default")]:
        test = ds[held] if name == "held-out" else train
        with expected_warnings():
            forecast = estimator.predict(test)
        errors = horizon_errors(forecast, test).to_numpy()
        some = windows(LENGTH)
        result["tests"][name] = {
            "errors": between(errors),
            "windows": {window: errors[:, some[window]].mean(axis=1) for window in WINDOWS},
        }
        if name == "held-out" and states == "attitude" and (model, settings) in PICTURED:
            result["predicted"] = forecast.mean[:, SHOWN_EVERY - 1 :: SHOWN_EVERY]
    return result


def between(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean error from after one shown horizon up to the next, which tames what the noise does."""
    first = np.r_[0, shown_horizons(LENGTH)[:-1]]
    return np.add.reduceat(errors, first, axis=1) / np.diff(np.r_[first, LENGTH])


def estimator_of(model: str, settings: str, *, mode: str, seed: int) -> Any:
    """Estimator by name: those of `build`, baselines, and those that know the reference."""
    if settings == "baseline":
        return HoldForecaster() if model == "hold" else MeanEpisodeForecaster()
    if model == "C":
        estimator = OneStepRegressor(inputs=("references",), random_state=seed)
        return estimator.set_params(
            **({"estimator__max_steps": QUICK_STEPS} if mode == "quick" else {})
        )
    name = "T" if model.startswith("T") else model
    estimator = build(name, settings, policy=None, mode=mode, seed=seed)
    return estimator.set_params(baseline=state_of) if model == "T, tracking error" else estimator


def state_of(references: NDArray[np.float64]) -> NDArray[np.float64]:
    """All twelve states of a craft on its set-point, level and at rest."""
    states = np.zeros((len(references), len(STATES["all"])))
    states[:, :3] = references[:, :3]
    states[:, STATES["all"].index("yaw")] = references[:, 3]
    return states


# -- tables -------------------------------------------------------------------------------


def run(run: Run) -> Tables:
    """Curves over all windows, errors by window, and the picture; nothing without the flights."""
    try:
        ds = flights()
    except OSError as error:
        print(f"quadrotor-real is left out, its flights cannot be had: {error}")
        return {}
    names = list(dict.fromkeys(np.asarray(ds.group).tolist()))
    cells = [
        {"states": states, "model": model, "settings": settings, "flight": flight}
        | {"mode": run.mode, "seed": seed}
        for states in STATES
        for model, settings in models(states)
        for flight in names
        for seed in (run.seeds[:1] if settings == "baseline" else run.seeds)
    ]
    curves: dict[tuple[Any, ...], list[Any]] = {}
    by_window, predicted = [], {}
    for asked, result in zip(cells, run.cells(cells, cell), strict=True):
        model, settings = asked["model"], asked["settings"]
        name = model if settings == "baseline" else label(model, settings)
        actions = "logged" if model in ("D", "PE", "LSTM") else "none"
        if "predicted" in result and asked["seed"] == run.seeds[0]:
            predicted[name, asked["flight"]] = np.array(result["predicted"])
        for test, some in result["tests"].items():
            key = {"states": asked["states"], "model": name, "actions": actions, "test": test}
            key |= {"seed": asked["seed"]}
            curves.setdefault(tuple(key.items()), []).append(np.array(some["errors"], float))
            lines = {"flight": asked["flight"], "window": range(len(some["errors"]))}
            by_window.append(pd.DataFrame(key | lines | some["windows"]))
    windows_table = pd.concat(by_window, ignore_index=True)
    return {
        "real-curves": pd.concat(map(_curve, curves, curves.values()), ignore_index=True),
        "real-episodes": windows_table,
        "real-states": _picture(ds, windows_table, predicted),
    }


def _curve(key: tuple[Any, ...], errors: list[NDArray[np.float64]]) -> pd.DataFrame:
    """Statistics over the windows of all flights."""
    table = pd.DataFrame(np.concatenate(errors), columns=shown_horizons(LENGTH))
    kept = ["median", "q65", "q95", "n_diverged"]
    columns = summarise(table)[kept].rename_axis("horizon").reset_index()
    return pd.DataFrame(dict(key) | columns.to_dict("list"))


def _picture(
    ds: TrajectoryDataset,
    by_window: pd.DataFrame,
    predicted: dict[tuple[str, str], NDArray[np.float64]],
) -> pd.DataFrame:
    """States of the held-out window on which the paper's T has its median error (the lower)."""
    some = by_window[(by_window["states"] == "attitude") & (by_window["test"] == "held-out")]
    some = some[(some["model"] == "T") & (some["seed"] == some["seed"].min())]
    ordered = some.sort_values("long", kind="stable")
    flight, number = ordered[["flight", "window"]].iloc[(len(ordered) - 1) // 2]
    own = ds[np.asarray(ds.group) == flight].select_states(STATES["attitude"])[int(number)]
    steps = np.arange(SHOWN_EVERY, LENGTH + 1, SHOWN_EVERY)
    table = pd.DataFrame(
        {"window": own.id, "truth": own.states[steps].ravel()},
        pd.MultiIndex.from_product([steps, STATES["attitude"]], names=["horizon", "state"]),
    )
    for (name, of), states in predicted.items():
        if of == flight:
            table[name] = states[int(number)].ravel()
    return table.reset_index()
