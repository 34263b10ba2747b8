"""The values that the paper swept for its models, as settings of ours.

Its table also has the optimizer (Adam or SGD; only Adam is offered here) and the split of rows into
training and test, which is no parameter where folds hold out whole episodes.
"""

from typing import Any

BATCHES = (16, 32, 64, 128, 256)
ROWS = (5e4, 1e5, 2e5, 5e5, 1e6)
#: Share of the paper's cap on training rows that it trained T on; it held out the rest.
TRAINED = 0.8
#: The values that the paper swept, by model and parameter.
SWEPT: dict[str, dict[str, tuple[float, ...]]] = {
    "D": {
        "width": (250, 300, 500),
        "depth": (2, 3),
        "batch size": BATCHES,
        "learning rate": (1e-5, 5e-5, 1e-4),
    },
    "T": {
        "width": (250, 300, 500),
        "depth": (2, 3),
        "batch size": BATCHES,
        "learning rate": (1e-4, 4e-4, 8e-4),
        "rows": ROWS,
        "rows, same steps": ROWS,
    },
    "LSTM": {
        "batch size": (1, 2, 4),
        "learning rate": (8e-5, 1e-4, 1e-3),
        "training length": (100, 200),
    },
}
#: The paper's final values.
FINAL: dict[str, dict[str, float]] = {
    "D": {"width": 250, "depth": 2, "batch size": 32, "learning rate": 5e-5},
    "T": {"width": 250, "depth": 2, "batch size": 64, "learning rate": 8e-4, "rows": 1e5},
    "LSTM": {"batch size": 1, "learning rate": 1e-3, "training length": 200},
}
FINAL["T"]["rows, same steps"] = FINAL["T"]["rows"]
#: One learning rate above any that the paper swept.
BEYOND = {"D": 1e-3, "T": 3e-3, "LSTM": 3e-3}


def values(model: str, parameter: str) -> list[float]:
    """The paper's values, then the one beyond."""
    beyond = [BEYOND[model]] if parameter == "learning rate" else []
    return [*SWEPT[model][parameter], *beyond]


def setting(model: str, parameter: str, value: float, epochs: int) -> dict[str, Any]:
    """What `set_params` of the paper's model takes for one value of one parameter."""
    if model == "LSTM":
        names = {
            "batch size": "batch_size",
            "learning rate": "learning_rate",
            "training length": "window",
        }
        return {names[parameter]: value}
    if parameter in ("width", "depth"):
        width = value if parameter == "width" else FINAL[model]["width"]
        depth = value if parameter == "depth" else FINAL[model]["depth"]
        return {"estimator__hidden_layer_sizes": [int(width)] * int(depth)}
    if parameter.startswith("rows"):
        rows = {"relabeler__max_rows": int(TRAINED * value)}
        if parameter == "rows":
            return rows
        n_steps = epochs * int(TRAINED * FINAL["T"]["rows"] / FINAL["T"]["batch size"])
        return rows | {"estimator__max_epochs": None, "estimator__max_steps": n_steps}
    return {f"estimator__{parameter.replace(' ', '_')}": value}


def others(model: str, parameter: str) -> list[float]:
    """All values but the paper's final one."""
    return [value for value in values(model, parameter) if value != FINAL[model][parameter]]


def origin(model: str, parameter: str, value: float) -> str:
    """What a value is: "final", "swept" or "beyond"."""
    if value == FINAL[model][parameter]:
        return "final"
    return "swept" if value in SWEPT[model][parameter] else "beyond"


def shown(value: float) -> str:
    """A value as it is written: 250, 5e-5, 1e6."""
    if 0.01 <= value < 1e4:
        return f"{value:g}"
    mantissa, exponent = f"{value:e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"
