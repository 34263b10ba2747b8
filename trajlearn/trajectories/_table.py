"""Reading a long table: check its columns, bring the rows of each episode together."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._columns import _offsets

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["LongTable", "check_roles", "listed"]

# A column of numbers means one thing; a label may serve twice (group and context).
_NUMBERS = ("time", "states", "actions", "rewards", "params", "references")


class LongTable:
    """Columns of a frame with the rows of each episode brought together."""

    def __init__(self, frame: "pd.DataFrame", episode: str, *, has_time: bool) -> None:
        import pandas as pd

        codes, values = pd.factorize(frame[episode])
        if (codes < 0).any():
            row = int(np.flatnonzero(codes < 0)[0])
            raise InvalidEpisodeError(f"column {episode!r} (episode) is missing in row {row}.")
        self.frame = frame
        self.ids = _whole(values.tolist())
        # Stable: within an episode the rows stay in the table's order.
        moved = (np.diff(codes) < 0).any()
        self.order: NDArray[np.intp] | slice = slice(None)
        if moved:
            self.order = np.argsort(codes, kind="stable")
        if moved and not has_time:
            back = int(np.flatnonzero(np.diff(codes) < 0)[0]) + 1
            raise InvalidEpisodeError(
                f"episode {self.ids[codes[back]]}: its rows are interrupted by other episodes "
                f"(it goes on in row {back}), and no time column says that their order is right. "
                "Give time=, bring its rows together, or give two episodes two names."
            )
        self.counts = np.bincount(codes, minlength=len(values)).astype(np.intp)
        self.offsets = _offsets(self.counts)
        self.position = np.arange(len(codes)) - np.repeat(self.offsets[:-1], self.counts)
        self.is_step = np.ones(len(codes), dtype=bool)
        self.is_step[self.offsets[1:] - 1] = False

    def floats(self, columns: Sequence[str], field: str) -> NDArray[np.float64]:
        """Columns of numbers (rows, k)."""
        out = np.empty((len(self.is_step), len(columns)))
        for j, column in enumerate(columns):
            out[:, j] = _numbers(self.frame[column], column, field)[self.order]
        return out

    def steps(self, columns: Sequence[str], field: str) -> NDArray[np.float64] | Any:
        """Columns of numbers without the last row of each episode, or None."""
        return self.floats(columns, field)[self.is_step] if columns else None

    def constant(self, column: str, field: str) -> list[Any]:
        """One value an episode; NaN where it is missing on all of its rows."""
        import pandas as pd

        codes, values = pd.factorize(self.frame[column])
        codes = codes[self.order]
        first = codes[self.offsets[:-1]]
        changed = codes != np.repeat(first, self.counts)
        if changed.any():
            row = int(np.flatnonzero(changed)[0])
            i = int(np.searchsorted(self.offsets, row, side="right") - 1)
            hint = ""
            if field == "terminated":
                hint = (
                    " For a flag by row, use frame.groupby(episode)[column].transform('any') first."
                )
            raise InvalidEpisodeError(
                f"episode {self.ids[i]}: column {column!r} ({field}) changes in row "
                f"{row - self.offsets[i]} of the episode; it must be the same on all rows.{hint}"
            )
        found = values.tolist()
        return [np.nan if code < 0 else found[code] for code in first]

    def labels(self, column: str, field: str) -> list[Any]:
        """Text, whole numbers or booleans, one an episode."""
        values = self.constant(column, field)
        for label, value in zip(self.ids, values, strict=True):
            if value is np.nan:
                raise InvalidEpisodeError(
                    f"episode {label}: column {column!r} ({field}) is missing; give it for all "
                    "episodes or for none."
                )
        return _whole(values)

    def flags(self, column: str) -> list[bool]:
        values = self.labels(column, "terminated")
        for label, value in zip(self.ids, values, strict=True):
            if value not in (0, 1):
                raise InvalidEpisodeError(
                    f"episode {label}: column {column!r} (terminated) is {value!r}; give True or "
                    "False."
                )
        return [bool(value) for value in values]

    def origins(self, column: str) -> list[float]:
        _numbers(self.frame[column], column, "time_origin")
        return [float(value) for value in self.constant(column, "time_origin")]


def listed(columns: str | Sequence[str] | None) -> list[Any]:
    if columns is None:
        return []
    return [columns] if isinstance(columns, str) else list(columns)


def check_roles(frame: "pd.DataFrame", roles: Mapping[str, list[Any]]) -> None:
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise TypeError(f"frame must be a pandas DataFrame, got {type(frame).__name__}.")
    if not roles["states"]:
        raise ValueError("states names no column: give at least one.")
    known = set(frame.columns)
    missing = []
    for field, columns in roles.items():
        for column in columns:
            if column not in known:
                close = get_close_matches(str(column), [str(name) for name in frame.columns], n=1)
                hint = f"; did you mean {close[0]!r}?" if close else ""
                missing.append(f"{column!r} ({field}{hint})")
    if missing:
        shown = [str(name) for name in frame.columns[:30]]
        raise ValueError(
            f"the table lacks {', '.join(missing)}. Its columns are {shown}"
            f"{' and more' if len(frame.columns) > 30 else ''}."
        )
    uses: dict[Any, list[str]] = {}
    for field in _NUMBERS:
        for column in roles[field]:
            uses.setdefault(column, []).append(field)
    twice = [f"{column!r} ({', '.join(f)})" for column, f in uses.items() if len(f) > 1]
    if twice:
        raise ValueError(
            f"one column cannot serve two purposes: {', '.join(twice)}. Name it once, or copy it "
            "under another name."
        )
    repeated = set(frame.columns[frame.columns.duplicated()])
    repeated &= set(chain.from_iterable(roles.values()))
    if repeated:
        raise ValueError(f"the table has several columns called {sorted(map(str, repeated))}.")


def _numbers(series: "pd.Series", column: str, field: str) -> NDArray[np.float64]:
    import pandas as pd

    if series.dtype == object:
        series = series.infer_objects()
    if not (pd.api.types.is_numeric_dtype(series) or pd.api.types.is_bool_dtype(series)):
        hint = "convert it with pandas.to_numeric."
        if pd.api.types.is_datetime64_any_dtype(series) or series.dtype.kind == "m":
            hint = "convert it to seconds, e.g. (t - t.min()).dt.total_seconds()."
        raise InvalidEpisodeError(
            f"column {column!r} ({field}) has the type {series.dtype}, not numbers; {hint}"
        )
    return series.to_numpy(dtype=np.float64, na_value=np.nan)


def _whole(values: list[Any]) -> list[Any]:
    """Integers where a file kept whole numbers as floats."""
    if all(isinstance(value, float) and value.is_integer() for value in values):
        return [int(value) for value in values]
    return values
