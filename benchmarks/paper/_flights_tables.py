"""Tables of the study of real flights, from the results of its cells."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._flights_curves import on_phases
from benchmarks.paper._flights_data import ATTITUDE, HORIZONS, Flights, tracking_errors
from benchmarks.paper._flights_ranking import WINDOWS, rankings, repeats

Floats = NDArray[np.float64]

#: Group of the main comparison: most flights, and gains that matter.
MAIN = "line_y, upgraded motors"
ALL = "all"
STATES = (*("x", "y", "z", "vx", "vy", "vz"), *ATTITUDE, *("wx", "wy", "wz"))
#: Horizons of the skill of each state.
SKILL_AT = (1, 10, 50, 200)
GAINS = ("T, tracking error", "T, tracking error, no gains")
_N_RESAMPLES = 1000
# columns of the errors that groups have of their own
_BY_GROUP = ("driven_mm", "driven_median_mm", "driven_calm_mm", "attitude_deg")


class Errors:
    """Squared errors of every flight, by row, split and seed.

    Attributes
    ----------
    squared : dict
        From (split, row, seed) and the kind of start to (n_flights, n_horizons, d_s); NaN where a
        flight was not predicted.
    ranges : dict
        From split to the range of the training states (n_flights, d_s).
    """

    def __init__(self, every: Flights) -> None:
        self.every = every
        self.squared: dict[tuple[str, str, int], dict[str, Floats]] = {}
        self.ranges: dict[str, Floats] = {}
        self.scores: list[dict[str, Any]] = []
        self._number = {name: i for i, name in enumerate(every.ds.ids.tolist())}
        self._flown = tracking_errors(every.ds.states, every.ds, start_logged=every.start_logged)

    def add(self, split: str, fold: int, seed: int, result: dict[str, Any]) -> None:
        """Take in the result of a cell of forecasts."""
        which = [self._number[name] for name in result["flights"]]
        n, d_s = len(self.every.ds), len(result["range"])
        self.ranges.setdefault(split, np.full((n, d_s), np.nan))[which] = result["range"]
        for row, errors in result["rows"].items():
            kept = self.squared.setdefault((split, row, seed), {})
            for kind in ("motion", "later"):
                shape = (n, len(HORIZONS), d_s)
                values = np.array(errors[kind], dtype=float)
                kept.setdefault(kind, np.full(shape, np.nan))[which] = values
            if errors["tracking"] is not None:
                self.add_scores(split, fold, seed, result["flights"], {row: errors["tracking"]})

    def add_scores(
        self, split: str, fold: int, seed: int, names: Iterable[str], rows: dict[str, Any]
    ) -> None:
        """Take in predicted tracking errors of test flights, by row and window."""
        which = [self._number[name] for name in names]
        for row, windows in rows.items():
            for window in WINDOWS:
                predicted = np.array(windows[window], dtype=float)
                self.scores.append(
                    self._score_lines(split, row, window, seed, fold, which)
                    | {"predicted": predicted}
                )

    def _score_lines(
        self, split: str, row: str, window: str, seed: int, fold: int, which: Any
    ) -> dict[str, Any]:
        return {
            "split": split,
            "row": row,
            "window": window,
            "seed": seed,
            "fold": fold,
            "flight": self.every.ds.ids[which],
            "experiment": self.every.ds.group[which],
            "group": self.every.group[which],
            "flown": self._flown[window][which],
        }

    def score_table(self) -> pd.DataFrame:
        """A line a split, row, window, seed and flight, with the repeats as a row."""
        lines = [pd.DataFrame(some) for some in self.scores]
        everyone = np.arange(len(self.every.ds))
        for window in WINDOWS:
            head = self._score_lines("any", "repeats", window, 0, -1, everyone)
            guess = repeats(self.every, self._flown[window])
            lines.append(pd.DataFrame(head | {"predicted": guess}))
        return pd.concat(lines, ignore_index=True)


def tables(errors: Errors) -> dict[str, pd.DataFrame]:
    """All tables but the example."""
    scores = errors.score_table()
    common = scores[(scores["window"] == "common") & np.isfinite(scores["flown"])]
    by = ["split", "row", "group", "flight", "fold"]
    points = common.groupby(by, sort=False)[["predicted", "flown"]].mean().reset_index()
    shown = points["row"].isin(["T, tracking error", "direct GP", "nearest in time"])
    return {
        "errors": error_table(errors),
        "skill": skill_table(errors),
        "gains": gains_table(errors),
        "floor": floor_table(errors.every),
        "ranking": rankings(scores),
        "scores": points[shown],
    }


def driven(squared: Floats, group: NDArray[np.str_]) -> Floats:
    """Squared distance along the driven axes (n_flights, n_horizons)."""
    x, y = squared[..., 0], squared[..., 1]
    line_x = np.char.startswith(group, "line_x")[:, None]
    line_y = np.char.startswith(group, "line_y")[:, None]
    return np.where(line_y, y, np.where(line_x, x, x + y))


def error_table(errors: Errors) -> pd.DataFrame:
    """A line a split, kind of start, group, row, seed and horizon.

    ``driven_mm``: root mean square over flights, along the driven axes; ``driven_median_mm``:
    median over flights of that of a flight; ``attitude_deg``: root mean square of roll, pitch and
    yaw; ``nmse``: of the 12 states, in training ranges, of all groups together only. With
    ``calm``: without the nearly unstable flights.
    """
    every, lines = errors.every, []
    attitude = [STATES.index(name) for name in ATTITUDE]
    for (split, row, seed), kinds in errors.squared.items():
        for start, squared in kinds.items():
            along = driven(squared, every.group)
            angle = squared[..., attitude].mean(axis=2)
            nmse = (squared / errors.ranges[split][:, None] ** 2).mean(axis=2)
            for group in (ALL, *np.unique(every.group)):
                mine = (every.group == group) | (group == ALL)
                calm = mine & ~every.violent
                columns = {
                    "driven_mm": 1e3 * np.sqrt(_mean(along[mine])),
                    "driven_median_mm": 1e3 * np.sqrt(_median(along[mine])),
                    "driven_calm_mm": 1e3 * np.sqrt(_mean(along[calm])),
                    "attitude_deg": np.degrees(np.sqrt(_mean(angle[mine]))),
                    "attitude_calm_deg": np.degrees(np.sqrt(_mean(angle[calm]))),
                    "nmse": _mean(nmse[mine]),
                    "nmse_median": _median(nmse[mine]),
                    "nmse_calm": _mean(nmse[calm]),
                }
                if group != ALL:
                    columns |= dict.fromkeys([c for c in columns if c not in _BY_GROUP], np.nan)
                head = {"split": split, "start": start, "group": group, "row": row, "seed": seed}
                lines.append(pd.DataFrame(head | {"horizon": HORIZONS} | columns))
    return pd.concat(lines, ignore_index=True)


def skill_table(errors: Errors) -> pd.DataFrame:
    """Skill of each state against the mean flight, later starts, median over seeds."""
    at = [HORIZONS.index(h) for h in SKILL_AT]
    lines = []
    for (split, row, seed), kinds in errors.squared.items():
        if row == "mean flight":
            continue
        base = errors.squared[split, "mean flight", 0]["later"]
        for group in np.unique(errors.every.group):
            mine = errors.every.group == group
            with np.errstate(divide="ignore", invalid="ignore"):
                value = 1 - _mean(kinds["later"][mine]) / _mean(base[mine])
            for j, name in enumerate(STATES):
                line = {"split": split, "group": group, "row": row, "seed": seed, "state": name}
                lines.append(pd.DataFrame(line | {"horizon": SKILL_AT, "skill": value[at, j]}))
    by = ["split", "group", "row", "state", "horizon"]
    table = pd.concat(lines, ignore_index=True)
    return table.groupby(by, sort=False)["skill"].median().round(3).reset_index()


def gains_table(errors: Errors) -> pd.DataFrame:
    """Error of T with gains over that without: what theta adds.

    Ratios of root mean square errors along the driven axes and of the 12 states, later starts,
    over the flights of all seeds, with the middle 90 % of a bootstrap over experiments.
    """
    every, lines = errors.every, []
    rng = np.random.default_rng(0)
    for split in sorted(errors.ranges):
        both = []
        for row in GAINS:
            seeds = [
                v["later"] for (s, r, _), v in errors.squared.items() if (s, r) == (split, row)
            ]
            if not seeds:
                return pd.DataFrame(columns=["split", "group", "quantity", "horizon", "ratio"])
            both.append(np.mean(seeds, axis=0))
        for group in np.unique(every.group):
            mine = every.group == group
            for quantity in ("driven", "12 states"):
                pair = [_quantity(errors, split, one, quantity)[mine] for one in both]
                drawn = _ratios(*pair, every.ds.group[mine], rng)
                ratio = np.sqrt(_mean(pair[0]) / _mean(pair[1]))
                low, high = np.nanquantile(drawn, [0.05, 0.95], axis=0)
                head = {"split": split, "group": group, "quantity": quantity}
                columns = {"horizon": HORIZONS, "ratio": ratio, "low": low, "high": high}
                lines.append(pd.DataFrame(head | columns))
    return pd.concat(lines, ignore_index=True)


def _quantity(errors: Errors, split: str, squared: Floats, quantity: str) -> Floats:
    if quantity == "driven":
        return driven(squared, errors.every.group)
    return (squared / errors.ranges[split][:, None] ** 2).mean(axis=2)


def _ratios(first: Floats, second: Floats, experiment: Any, rng: np.random.Generator) -> Floats:
    """Bootstrapped ratios of root mean squares (n_resamples, n_horizons), whole experiments."""
    _, which = np.unique(experiment, return_inverse=True)
    n = which.max() + 1
    weight = rng.multinomial(n, np.full(n, 1 / n), size=_N_RESAMPLES)[:, which].astype(float)
    a, b = (weight @ np.nan_to_num(some) for some in (first, second))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(a / b)


def floor_table(every: Flights) -> pd.DataFrame:
    """Standard deviation between repeats of the same gains in an experiment, by group and state.

    At the same phase, over the part of the motion that all flights have; pooled over settings.
    ``between``: between all flights of the group; ``n_repeats``: degrees of freedom.
    """
    lines = []
    for group in np.unique(every.group):
        mine = np.flatnonzero(every.group == group)
        curves = on_phases(every.ds[mine])
        frame = pd.DataFrame(every.ds.params[mine]).assign(experiment=every.ds.group[mine])
        setting = frame.groupby(list(frame)).ngroup().to_numpy()
        total, n_repeats = np.zeros(curves.shape[2]), 0
        for one in np.unique(setting):
            some = curves[setting == one]
            total += ((some - some.mean(axis=0)) ** 2).mean(axis=1).sum(axis=0)
            n_repeats += len(some) - 1
        between = ((curves - curves.mean(axis=0)) ** 2).mean(axis=1).sum(axis=0)
        between = np.sqrt(between / max(len(curves) - 1, 1))
        repeat = np.sqrt(total / n_repeats) if n_repeats else np.full(len(total), np.nan)
        columns = {"state": STATES, "repeats": repeat, "between": between}
        lines.append(pd.DataFrame({"group": group, "n_repeats": n_repeats} | columns))
    return pd.concat(lines, ignore_index=True)


def _mean(values: Floats) -> Floats:
    """Mean over flights, NaN left out; infinite if one is."""
    return _reduced(np.mean, values)


def _median(values: Floats) -> Floats:
    return _reduced(np.median, values)


def _reduced(how: Any, values: Floats) -> Floats:
    columns = values.reshape(len(values), -1).T
    there = [column[~np.isnan(column)] for column in columns]
    found = [how(some) if len(some) else np.nan for some in there]
    return np.array(found).reshape(values.shape[1:])
