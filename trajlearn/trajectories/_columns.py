"""Ragged storage: one contiguous array a field, and where each episode begins in it.

``offsets`` (n + 1,) counts states: episode i owns the rows ``offsets[i]:offsets[i + 1]`` of
every field with one row a state. An episode of T steps has T + 1 states, so fields with one
row a step begin ``i`` rows earlier, at ``offsets[i] - i``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import InvalidEpisodeError

Floats = NDArray[np.float64]

STATE_FIELDS = ("states", "times", "references", "observed")
STEP_FIELDS = ("actions", "rewards")
EPISODE_FIELDS = ("terminated", "time_origin", "ids", "group")
VECTOR_FIELDS = ("states", "actions", "params", "references")


@dataclass(frozen=True, kw_only=True)
class Columns:
    """All fields of all episodes; absent ones are None.

    ``params`` has one row an episode, or one a step where `params_per_step` is true. ``observed``
    are the states as logged, where a transformer replaced them by estimates, and `hindsight` tells
    that these estimates have seen what follows them.
    """

    offsets: NDArray[np.intp]
    states: Floats
    times: Floats
    terminated: NDArray[np.bool_]
    time_origin: Floats
    ids: NDArray[Any]
    actions: Floats | None = None
    rewards: Floats | None = None
    params: Floats | None = None
    references: Floats | None = None
    observed: Floats | None = None
    group: NDArray[Any] | None = None
    context: dict[str, NDArray[Any]] = field(default_factory=dict)
    params_per_step: bool = False
    hindsight: bool = False

    @property
    def n_episodes(self) -> int:
        return len(self.offsets) - 1

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Steps in each episode (n,)."""
        return np.diff(self.offsets) - 1

    @property
    def step_offsets(self) -> NDArray[np.intp]:
        """Where the steps of each episode begin (n + 1,)."""
        return self.offsets - np.arange(len(self.offsets))

    def freeze(self) -> "Columns":
        """Make every array read-only (numpy loses the flag in pickles)."""
        for item in fields(self):
            value = getattr(self, item.name)
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False
        return self

    def take(self, index: NDArray[np.intp]) -> "Columns":
        """Rows of the given episodes, in that order (repeats allowed)."""
        return self.cut(index, np.zeros_like(index), self.lengths[index])

    def cut(
        self, index: NDArray[np.intp], start: NDArray[np.intp], n_steps: NDArray[np.intp]
    ) -> "Columns":
        """Stretches of `n_steps` steps, each from the state `start` of the episode `index` on."""
        state_rows = runs(self.offsets[index] + start, n_steps + 1)
        step_rows = runs(self.step_offsets[index] + start, n_steps)
        chosen: dict[str, Any] = {}
        for name in STATE_FIELDS:
            chosen[name] = _rows(getattr(self, name), state_rows)
        for name in STEP_FIELDS:
            chosen[name] = _rows(getattr(self, name), step_rows)
        for name in EPISODE_FIELDS:
            chosen[name] = _rows(getattr(self, name), index)
        chosen["params"] = _rows(self.params, step_rows if self.params_per_step else index)
        chosen["context"] = {key: values[index] for key, values in self.context.items()}
        chosen["offsets"] = _offsets(n_steps + 1)
        return replace(self, **chosen).canonical().freeze()

    def canonical(self) -> "Columns":
        """Keep theta by step only where it really changes inside an episode."""
        if self.params is None or not self.params_per_step:
            return self
        first = self.params[self.step_offsets[:-1]]
        if not np.array_equal(self.params, np.repeat(first, self.lengths, axis=0)):
            return self
        return replace(self, params=first, params_per_step=False)


def _rows(values: NDArray[Any] | None, rows: NDArray[np.intp]) -> NDArray[Any] | None:
    return None if values is None else values[rows]


def _offsets(counts: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.concatenate([np.zeros(1, dtype=np.intp), np.cumsum(counts, dtype=np.intp)])


def runs(begin: NDArray[np.intp], counts: NDArray[np.intp], stride: int = 1) -> NDArray[np.intp]:
    """``begin[i], begin[i] + stride, ...`` (``counts[i]`` of them) for all i, without a loop."""
    position = np.arange(counts.sum(), dtype=np.intp) - np.repeat(_offsets(counts)[:-1], counts)
    return np.repeat(begin, counts) + stride * position


def pack(episodes: Sequence[Mapping[str, Any]], labels: Sequence[Any]) -> Columns:
    """Concatenate and validate episodes given as mappings from field to value.

    Parameters
    ----------
    episodes : sequence of mapping
        Values as in `Trajectory`; ``dt`` stands in for missing ``times``.
    labels : sequence
        What an error calls each episode.

    Raises
    ------
    InvalidEpisodeError
        On anything that no model could use; the message names the episode.
    """
    if not len(episodes):
        raise InvalidEpisodeError(
            "the dataset is empty: give at least one episode (a state array with two rows or more)"
        )
    arrays = [_episode_arrays(episode, label) for episode, label in zip(episodes, labels)]
    counts = np.array([len(item["states"]) for item in arrays], dtype=np.intp)
    columns: dict[str, Any] = {"offsets": _offsets(counts), "ids": _plain(labels, "episode id")}
    for name in (*STATE_FIELDS, *STEP_FIELDS):
        columns[name] = _stack([item[name] for item in arrays], name, labels)
    columns["params_per_step"], columns["params"] = _stack_params(arrays, counts - 1, labels)
    columns["terminated"] = np.array([item["terminated"] for item in arrays])
    columns["time_origin"] = np.array([float(item["time_origin"]) for item in arrays])
    groups = [item["group"] for item in arrays]
    if any(value is not None for value in groups):
        columns["group"] = _plain(groups, "group", labels)
    columns["context"] = _stack_context([item["context"] for item in arrays], labels)
    packed = Columns(**columns)
    _check_values(packed, labels)
    return packed.freeze()


def _episode_arrays(episode: Mapping[str, Any], label: Any) -> dict[str, Any]:
    """Convert one episode's fields to arrays of the right rank and length."""
    absent = (*STATE_FIELDS, *STEP_FIELDS, "params", "group", "context")
    out: dict[str, Any] = dict.fromkeys(absent)
    out |= {"terminated": False, "time_origin": np.nan} | dict(episode)
    out["context"] = {str(key): value for key, value in (out["context"] or {}).items()}
    if out["time_origin"] is None:
        out["time_origin"] = np.nan
    if not (np.ndim(out["terminated"]) == 0 and out["terminated"] in (False, True)):
        raise InvalidEpisodeError(
            f"episode {label}: terminated is {out['terminated']!r}; give True or False."
        )
    out["terminated"] = bool(out["terminated"])
    states = _as_floats(out["states"], "states", label, ndim=2)
    n_steps = len(states) - 1
    if n_steps < 1:
        raise InvalidEpisodeError(
            f"episode {label}: states has {len(states)} row(s); an episode needs at least 2 "
            "(s_0 and s_1). Leave it out or log it longer."
        )
    if not states.shape[1]:
        raise InvalidEpisodeError(f"episode {label}: states has no columns.")
    out["states"] = states
    for name, rows in (("actions", n_steps), ("rewards", n_steps), ("references", n_steps + 1)):
        if out[name] is not None:
            ndim = 1 if name == "rewards" else 2
            out[name] = _as_floats(out[name], name, label, ndim=ndim)
            _check_rows(name, out[name], rows, n_steps, label)
            if ndim == 2 and not out[name].shape[1]:
                out[name] = None
    if out["params"] is not None:
        params = _as_floats(out["params"], "params", label, ndim=None)
        if params.ndim not in (1, 2):
            raise InvalidEpisodeError(
                f"episode {label}: params has shape {params.shape}; give (p,), or (T, p) where "
                "theta changes on the way."
            )
        if params.ndim == 2:
            _check_rows("params", params, n_steps, n_steps, label)
        out["params"] = params if params.shape[-1] else None
    if out["times"] is None:
        dt = float(out.get("dt", 1.0))
        if not (np.isfinite(dt) and dt > 0):
            raise InvalidEpisodeError(f"episode {label}: dt = {dt} must be positive and finite.")
        out["times"] = np.arange(n_steps + 1) * dt
    else:
        out["times"] = _as_floats(out["times"], "times", label, ndim=1)
        _check_rows("times", out["times"], n_steps + 1, n_steps, label)
    return out


def _as_floats(value: Any, name: str, label: Any, ndim: int | None) -> Floats:
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.filled(value.astype(np.float64), np.nan)
    try:
        if np.iscomplexobj(value):
            raise TypeError("complex numbers")
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidEpisodeError(
            f"episode {label}: {name} is not an array of numbers ({error})."
        ) from error
    if ndim is not None and array.ndim != ndim:
        want = {1: "one number a row", 2: "a 2-D array with one row a time"}[ndim]
        raise InvalidEpisodeError(
            f"episode {label}: {name} has shape {array.shape}; expected {want}."
        )
    return array


def _check_rows(name: str, array: Floats, rows: int, n_steps: int, label: Any) -> None:
    if len(array) == rows:
        return
    hint = ""
    if name in ("actions", "rewards", "params") and len(array) == n_steps + 1:
        hint = f" {name}[t] belongs to the step from s_t to s_(t+1): drop the last row."
    raise InvalidEpisodeError(
        f"episode {label}: {name} has {len(array)} rows, but {n_steps + 1} states "
        f"({n_steps} steps) need {rows}.{hint}"
    )


def _stack(values: list[Any], name: str, labels: Sequence[Any]) -> Floats | None:
    missing = [label for value, label in zip(values, labels) if value is None]
    if len(missing) == len(values):
        return None
    if missing:
        raise InvalidEpisodeError(
            f"{name} is missing in {len(missing)} of {len(values)} episodes (first: episode "
            f"{missing[0]}): give it for all episodes or for none."
        )
    widths = [value.shape[1:] for value in values]
    for width, label in zip(widths, labels):
        if width != widths[0]:
            raise InvalidEpisodeError(
                f"episode {label}: {name} has {width[0]} columns, episode {labels[0]} has "
                f"{widths[0][0]}; all episodes need the same."
            )
    return np.concatenate(values)


def _stack_params(
    arrays: list[dict[str, Any]], n_steps: NDArray[np.intp], labels: Sequence[Any]
) -> tuple[bool, Floats | None]:
    """Params by episode; by step only where theta really changes inside some episode."""
    values = []
    for item in arrays:
        params = item["params"]
        if params is not None and params.ndim == 2 and (params == params[0]).all():
            params = params[0]
        values.append(params)
    per_step = any(value is not None and value.ndim == 2 for value in values)
    rows = [
        value
        if value is None or value.ndim == 2
        else np.broadcast_to(value, (steps if per_step else 1, len(value)))
        for value, steps in zip(values, n_steps)
    ]
    return per_step, _stack(rows, "params", labels)


def _stack_context(contexts: list[dict[str, Any]], labels: Sequence[Any]) -> dict[str, NDArray]:
    keys = list(contexts[0])
    for context, label in zip(contexts, labels):
        if set(context) != set(keys):
            raise InvalidEpisodeError(
                f"episode {label}: context has the keys {sorted(context)}, episode {labels[0]} "
                f"has {sorted(keys)}; all episodes need the same."
            )
    return {key: _plain([c[key] for c in contexts], f"context {key!r}", labels) for key in keys}


def _plain(values: Sequence[Any], name: str, labels: Sequence[Any] = ()) -> NDArray[Any]:
    """One array of text, whole numbers or booleans; never of Python objects."""
    for value, label in zip(values, labels):
        if value is None or (isinstance(value, (float, np.floating)) and np.isnan(value)):
            raise InvalidEpisodeError(
                f"episode {label}: {name} is missing; give it for all episodes or for none."
            )
    array = np.array(values)
    kinds = {type(value) for value in array.tolist()} if array.dtype != object else {object}
    # numpy would turn 1 next to "a" into "1", and True next to 2 into 1
    mixed = array.dtype.kind in "US" and any(not isinstance(v, (str, bytes)) for v in values)
    mixed |= array.dtype.kind in "iu" and any(isinstance(v, (bool, np.bool_)) for v in values)
    if array.ndim != 1 or array.dtype.kind not in "USiub" or len(kinds) > 1 or mixed:
        raise InvalidEpisodeError(
            f"{name} must be all text, all whole numbers or all booleans, one value an episode; "
            f"got {sorted({type(v).__name__ for v in values})}."
        )
    return array


def _check_values(columns: Columns, labels: Sequence[Any]) -> None:
    # Times first: rows out of order are the cause, a missing action among them a symptom.
    _check_finite("times", columns, labels)
    steps = np.diff(columns.times)
    steps[columns.offsets[1:-1] - 1] = 1.0
    if (steps <= 0).any():
        row = int(np.flatnonzero(steps <= 0)[0])
        episode = int(np.searchsorted(columns.offsets, row, side="right") - 1)
        before, after = columns.times[row : row + 2].tolist()
        raise InvalidEpisodeError(
            f"episode {labels[episode]}: times must increase strictly, but go from {before} to "
            f"{after} at row {row - columns.offsets[episode]}. Sort the rows by time and drop "
            "repeated ones."
        )
    for name in ("states", *STEP_FIELDS, "params", "references", "observed"):
        _check_finite(name, columns, labels)
    if np.isinf(columns.time_origin).any():
        episode = int(np.flatnonzero(np.isinf(columns.time_origin))[0])
        raise InvalidEpisodeError(
            f"episode {labels[episode]}: time_origin is infinite; give NaN where it is unknown."
        )


def _check_finite(name: str, columns: Columns, labels: Sequence[Any]) -> None:
    values = getattr(columns, name)
    if values is None or np.isfinite(values).all():
        return
    bad = np.argwhere(~np.isfinite(values))[0]
    if name in STATE_FIELDS:
        starts = columns.offsets
    elif name == "params" and not columns.params_per_step:
        starts = np.arange(columns.n_episodes + 1)
    else:
        starts = columns.step_offsets
    episode = int(np.searchsorted(starts, bad[0], side="right") - 1)
    where = f"row {bad[0] - starts[episode]}"
    where += f", column {bad[1]}" if len(bad) > 1 else ""
    raise InvalidEpisodeError(
        f"episode {labels[episode]}: {name} is {values[tuple(bad)]} at {where}. Remove or "
        "interpolate such samples, or cut the episode there."
    )
