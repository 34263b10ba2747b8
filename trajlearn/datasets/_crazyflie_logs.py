"""The Crazyflie tuning campaign from its binary logs: the same two tables as the derived ones."""

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from trajlearn.datasets.usd import read_usd_log
from trajlearn.exceptions import UnknownFileError

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["GAINS", "decode_flight", "kind_of", "read_crazyflie_logs"]

GAINS = tuple(
    [f"Kpos_{term}{axis}" for term in "PID" for axis in "xyz"]
    + [f"{gain}_{axis}" for gain in ("KR", "KI", "Kw") for axis in "xyz"]
)
# column -> variable of the log, by the plot settings of the source, and its unit in SI units
_VARIABLES = {
    **{axis: (f"stateEstimateZ.{axis}", 1e-3) for axis in ("x", "y", "z", "vx", "vy", "vz")},
    **{name: (f"ctrlLee.rpy{axis}", 1.0) for name, axis in zip(("roll", "pitch", "yaw"), "xyz")},
    **{f"w{axis}": (f"ctrlLee.omega{axis}", 1.0) for axis in "xyz"},
    **{f"r{axis}": (f"ctrltargetZ.{axis}", 1e-3) for axis in ("x", "y", "z", "vx", "vy", "vz")},
    "thrust": ("ctrlLee.thrustSI", 1.0),
    **{f"t{axis}": (f"ctrlLee.torque{axis}", 1.0) for axis in "xyz"},
}
_EVENT = "fixedFrequency"
_LAST_EXPERIMENT = 200  # what comes later has another mass and another task
_LAST_UPGRADED = 145  # says the source's own description
_FIRST_STEPS = 10  # the card stalls once, some 16 ms after the start
_MAX_GAP_S = 0.1  # samples are 4 ms apart, in the source 24 ms at most


def read_crazyflie_logs(folder: Path, dt: float) -> tuple["pd.DataFrame", "pd.DataFrame"]:
    """Decode ``logs/`` with the gains in ``info/`` of a checkout of the source.

    Parameters
    ----------
    folder : Path
    dt : float
        Step of the grid that the samples are interpolated to [s].

    Returns
    -------
    flights : DataFrame
        One row a flight: flight, experiment, kind, airborne_only, suspect, motors, mass and gains.
    samples : DataFrame
        One row a sample: flight, t, states, references and actions in SI units.

    Raises
    ------
    UnknownFileError
        If no log can be read; one that cannot is left out with a warning.
    """
    import pandas as pd

    paths = {
        path: int(match[1])
        for path in (folder / "logs").iterdir()
        if (match := re.fullmatch(r"log(\d+)(_.*)?", path.name))
    }
    rows, tables, problems = [], [], {}
    for path in sorted(paths, key=lambda path: (paths[path], path.name)):
        if paths[path] > _LAST_EXPERIMENT:
            continue
        try:
            gains = _read_gains(
                folder / "info" / f"{path.name.split('_')[0]}.yaml".replace("log", "info")
            )
            flight = decode_flight(path, dt)
        except UnknownFileError as error:
            problems[path.name] = str(error)
            continue
        rows.append({"flight": path.name, "experiment": paths[path], **_facts(flight), **gains})
        rows[-1]["motors"] = "upgraded" if paths[path] <= _LAST_UPGRADED else "standard"
        flight.insert(0, "flight", path.name)
        tables.append(flight)
    if not rows:
        raise UnknownFileError(
            f"{folder / 'logs'} has no log that can be read. {next(iter(problems.values()), '')}"
        )
    if problems:
        warnings.warn(
            f"{len(problems)} of {len(problems) + len(rows)} logs are left out "
            f"({', '.join(problems)}); the first: {next(iter(problems.values()))}",
            stacklevel=4,
        )
    return pd.DataFrame(rows), pd.concat(tables, ignore_index=True)


def decode_flight(path: Path, dt: float) -> "pd.DataFrame":
    """One log after its initial stall, linear between samples, from t = 0 in steps of `dt`.

    Raises
    ------
    UnknownFileError
        If the file is no log or was damaged, lacks variables (the message names them and those
        it has), has missing values, or a gap in mid-flight: nobody knows what happened there.
    """
    import pandas as pd

    # A log whose end was lost still holds the flight before it.
    log = read_usd_log(path, allow_truncated=True)
    if _EVENT not in log:
        raise UnknownFileError(f"{path} has no event {_EVENT!r}; it has {sorted(log)}.")
    times, variables = log[_EVENT].times, log[_EVENT].variables
    missing = sorted({name for name, _ in _VARIABLES.values()} - set(variables))
    if missing:
        raise UnknownFileError(
            f"{path} lacks the variables {missing}; it has {sorted(variables)}. Use the logs of "
            "the commit named in the documentation of load_crazyflie_gains."
        )
    steps = np.diff(times)
    if len(times) < 2 * _FIRST_STEPS or np.any(steps <= 0):
        raise UnknownFileError(
            f"{path} has {len(times)} samples or times that go back: leave it out."
        )
    first = int(np.argmax(steps[:_FIRST_STEPS])) + 1
    gap = int(np.argmax(steps[first:])) + first
    if steps[gap] > _MAX_GAP_S:
        raise UnknownFileError(
            f"{path} has no samples for {steps[gap]:.2f} s after {times[gap] - times[first]:.2f} s "
            "of flight: leave it out."
        )
    times = times[first:] - times[first]
    # Round-off must not cost the last sample.
    grid = dt * np.arange(int(times[-1] / dt + 1e-6) + 1)
    columns = {"t": grid}
    for column, (name, unit) in _VARIABLES.items():
        values = unit * variables[name][first:].astype(np.float64)
        if not np.isfinite(values).all():
            raise UnknownFileError(
                f"{path} has missing or infinite values of {name}: leave it out."
            )
        values = np.unwrap(values) if column in ("roll", "pitch", "yaw") else values
        columns[column] = np.interp(grid, times, values)
    return pd.DataFrame(columns)


def kind_of(reference: np.ndarray) -> str:
    """What a flight was, from its logged reference (m, 2) in the plane."""
    along_x, along_y = np.ptp(reference, axis=0) > 0.1
    if along_x and along_y:
        return "figure8"
    return "line_x" if along_x else "line_y" if along_y else "hover"


def _facts(flight: "pd.DataFrame") -> dict[str, object]:
    reference = flight[["rx", "ry"]].to_numpy()
    error = np.linalg.norm(flight[["x", "y"]].to_numpy() - reference, axis=1)
    rates = np.abs(flight[["wx", "wy", "wz"]].to_numpy())
    return {
        "kind": kind_of(reference),
        "airborne_only": bool(flight["rz"].min() > 0.5),
        "suspect": bool(rates.max() > 5.0 or error.max() > 0.6),
    }


def _read_gains(path: Path) -> dict[str, float]:
    """The gains and the mass, from a file of lines ``name: value``."""
    if not path.is_file():
        raise UnknownFileError(f"{path} is missing: it has the gains of the flight.")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UnknownFileError(f"{path} is not UTF-8 text ({error}): copy it again.") from None
    entries = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    try:
        gains = {name: float(entries[name]) for name in ("mass", *GAINS)}
    except (KeyError, ValueError) as error:
        raise UnknownFileError(f"{path} lacks a gain or has no number there: {error}.") from None
    infinite = [name for name, value in gains.items() if not np.isfinite(value)]
    if infinite:
        raise UnknownFileError(f"{path} has no finite number for {', '.join(infinite)}.")
    return gains
