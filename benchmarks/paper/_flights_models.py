"""Models of real flights by name, and one fold of the study: fit, forecast, keep the errors."""

import time
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._flights_data import (
    HORIZONS,
    flights,
    folds,
    predicted_states,
    squared_errors,
    starts,
    tracking_errors,
    truth_at,
)
from benchmarks.paper._flights_kernel import GainsCurveForecaster, gain_scaler, linear_forecast
from benchmarks.paper._rollouts import expected_warnings
from trajlearn import (
    HoldForecaster,
    LSTMRegressor,
    MeanEpisodeForecaster,
    OneStepRegressor,
    ReferenceForecaster,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    paper,
)

Floats = NDArray[np.float64]

#: Gradient steps; those of the paper's T are its epochs in full mode.
STEPS = {
    "full": {"T": 4000, "T, long": 8000, "C": 2500, "D": 2500, "LSTM": 250},
    "quick": {"T": 800, "T, long": 1600, "C": 800, "D": 800, "LSTM": 60},
}
#: Rows that do not depend on a seed.
FIXED = ("hold", "reference", "mean flight", "kernel ridge", "kernel ridge + linear")
#: Rows of one cell: those that an average needs are fitted beside it.
AVERAGE = [
    "kernel ridge",
    "kernel ridge + linear",
    "T, tracking error",
    "T, kernel ridge",
    "C",
    "average",
]
NO_GAINS = ["T, tracking error, no gains"]
#: Twice the steps of the other T rows.
LONG = ["T, tracking error, long training"]
CELLS = [
    ["hold", "reference", "mean flight"],
    AVERAGE,
    NO_GAINS,
    LONG,
    ["T, state"],
    ["T, paper"],
    ["D, logged actions"],
    ["D, logged actions, previous"],
    ["LSTM, logged actions"],
]
#: Rows with logged actions know more than a forecast can.
LOGGED = tuple(row for rows in CELLS for row in rows if "logged" in row)
#: Rows of which no tracking error is asked: they are told the future, or say nothing of it.
_UNRANKED = ("hold", "reference", *LOGGED)
#: C alone up to the first horizon, the others alone from the second on, between by log h.
BLEND = (5, 50)
_T_INPUTS = ("state", "horizon", "context", "references", "phase")


def follow(references: Floats) -> Floats:
    """State of a perfect flight: position and velocity of the set-point, level, not turning."""
    return np.concatenate([references, np.zeros((len(references), 6))], axis=1)


def build(row: str, mode: str, seed: int) -> Any:
    """Estimator of a row, not fitted."""
    steps = STEPS[mode]
    if row in ("hold", "reference", "mean flight", "kernel ridge"):
        return {
            "hold": HoldForecaster,
            "reference": partial(ReferenceForecaster, follow),
            "mean flight": MeanEpisodeForecaster,
            "kernel ridge": GainsCurveForecaster,
        }[row]()
    if row == "T, paper":
        rows = SubtrajectoryRelabeler(
            max_rows=80_000, inputs=("state", "horizon", "params", "context")
        )
        model = paper.model("T", relabeler=rows, random_state=seed)
        return model.set_params(estimator__max_epochs=1) if mode == "quick" else model
    if row.startswith("T, "):
        return _trajectory(row, steps["T, long" if row in LONG else "T"], seed)
    if row == "C":
        model = OneStepRegressor(inputs="params", baseline=follow, random_state=seed)
        return model.set_params(
            scaler__params=gain_scaler(),
            estimator__hidden_layer_sizes=(128, 128),
            estimator__n_members=3,
            estimator__max_steps=steps["C"],
            estimator__weight_decay=0.1,
        )
    if row.startswith("D, "):
        previous = ("previous",) if row.endswith("previous") else ()
        inputs = ("state", "action", *previous, "context")
        return OneStepRegressor(inputs=inputs, random_state=seed).set_params(
            estimator__hidden_layer_sizes=(128, 128),
            estimator__n_members=5,
            estimator__max_steps=steps["D"],
        )
    if row.startswith("LSTM"):
        return LSTMRegressor(
            max_steps=steps["LSTM"], learning_rate=5e-3, weight_decay=0.1, random_state=seed
        )
    raise ValueError(f"there is no row {row!r}.")


def _trajectory(row: str, steps: int, seed: int) -> TrajectoryRegressor:
    baseline = {"T, state": "state", "T, kernel ridge": GainsCurveForecaster()}.get(row, follow)
    gains = not row.endswith("no gains")
    relabeler = SubtrajectoryRelabeler(
        starts="uniform",
        horizons="mixture",
        n_knots=3,
        inputs=(*_T_INPUTS, "params") if gains else _T_INPUTS,
    )
    model = TrajectoryRegressor(
        relabeler=relabeler, baseline=baseline, gate=0.025, random_state=seed
    )
    return model.set_params(
        scaler__params=gain_scaler(),
        estimator__hidden_layer_sizes=(200, 200),
        estimator__max_steps=steps,
        estimator__weight_decay=0.1,
    )


def cell(rows: list[str], split: str, fold: int, mode: str, seed: int) -> dict[str, Any]:
    """Fit the rows on a fold, and keep their errors on its test flights.

    Returns
    -------
    dict
        ``flights``: ids of the test flights; ``range``: of the training states (d_s,); ``rows``:
        of each row ``motion`` and ``later`` (see `squared_errors`), ``tracking`` (predicted, see
        `tracking_errors`) and ``seconds``.
    """
    every = flights()
    train, test = folds(every.ds, split)[fold]
    begun = every.start_logged[test]
    fitting, testing = every.ds[train], every.ds[test]
    at = truth_at(testing)
    predicted: dict[str, Floats] = {}
    fitted: dict[str, Any] = {}
    results = {}
    for row in rows:
        began = time.perf_counter()
        if row == "average":
            forecast = blend(predicted)
        elif row == "kernel ridge + linear":
            forecast = linear_forecast(fitting, testing, fitted["kernel ridge"])
        else:
            fitted[row] = build(row, mode, seed).fit(fitting)
            forecast = forecast_at(fitted[row], testing)
        predicted[row] = forecast
        errors = squared_errors(forecast, at, len(testing), motion=begun)
        results[row] = {**errors, "tracking": None, "seconds": time.perf_counter() - began}
        if row in fitted and row not in _UNRANKED:
            states = predicted_states(fitted[row], testing)
            results[row]["tracking"] = tracking_errors(states, testing, start_logged=begun)
    return {
        "flights": testing.ids.tolist(),
        "range": np.ptp(fitting.states, axis=0),
        "rows": results,
    }


def forecast_at(model: Any, ds: TrajectoryDataset) -> Floats:
    """States (n, n_horizons, d_s) that a model predicts from every start; NaN beyond the logs."""
    with expected_warnings():
        forecast = model.predict(ds, start=starts(ds), horizon=max(HORIZONS))
    states = np.full((len(forecast), max(HORIZONS), forecast.mean.shape[2]), np.nan)
    states[:, : forecast.mean.shape[1]] = forecast.mean
    return states[:, np.array(HORIZONS) - 1]


def blend(predicted: dict[str, Floats]) -> Floats:
    """Average of models that err in different ways, C for the first steps.

    The weights are not tuned.
    """
    others = ("kernel ridge + linear", "T, kernel ridge", "T, tracking error")
    mean = np.mean([predicted[row] for row in others], axis=0)
    share = np.interp(np.log(HORIZONS), np.log(BLEND), [1.0, 0.0])[:, None]
    closed = np.where(share > 0, predicted["C"], 0.0)
    return share * closed + (1 - share) * mean


def described(mode: str) -> dict[str, str]:
    """Parameters of the models with a learner, the same in all folds."""
    rows = [row for rows in CELLS for row in rows if row not in FIXED and row != "average"]
    return {row: " ".join(str(build(row, mode, 0)).split()) for row in rows}
