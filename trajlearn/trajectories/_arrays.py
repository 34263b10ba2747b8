"""Packing plain arrays, one item an episode, into columns."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._columns import VECTOR_FIELDS, Columns, pack

_PREFIX = {"states": "s", "actions": "a", "params": "theta", "references": "ref"}


def pack_arrays(
    states: Any,
    given: Mapping[str, Any],
    context: Mapping[str, Any],
    ids: Any,
    dt: float,
) -> Columns:
    """Columns of n episodes from sequences of n items; see `TrajectoryDataset.from_arrays`."""
    n = _size("states", states)
    fields = {name: _by_position(value) for name, value in given.items() if value is not None}
    facts = {key: _by_position(values) for key, values in context.items()}
    labels = range(n) if ids is None else _by_position(ids)
    for name, value in [*fields.items(), *facts.items(), ("ids", labels)]:
        if _size(name, value) != n:
            raise InvalidEpisodeError(
                f"{name} has {len(value)} items for {n} episodes: give one an episode."
            )
    episodes = [
        {name: value[i] for name, value in fields.items()}
        | {"states": states[i], "dt": dt}
        | {"context": {key: values[i] for key, values in facts.items()}}
        for i in range(n)
    ]
    columns = pack(episodes, list(labels))
    if len(np.unique(columns.ids)) < n:
        raise InvalidEpisodeError("ids repeat: give each episode its own, or leave ids out.")
    return columns


def _size(name: str, value: Any) -> int:
    try:
        return len(value)
    except TypeError as error:
        raise InvalidEpisodeError(
            f"{name} is {value!r}: give a sequence with one item an episode."
        ) from error


def _by_position(value: Any) -> Any:
    """Pandas objects would be indexed by label, not by position."""
    return value.to_numpy() if hasattr(value, "to_numpy") else value


def unique_ids(ids: Sequence[Hashable]) -> list[Any]:
    """Ids as given if they tell the episodes apart, else positions."""
    return list(ids) if len(set(ids)) == len(ids) else list(range(len(ids)))


def check_names(columns: Columns, *names: Sequence[str] | None) -> dict[str, tuple[str, ...]]:
    """Names of the columns of each vector field, in that order; numbered where None."""
    checked: dict[str, tuple[str, ...]] = {}
    for field, given in zip(VECTOR_FIELDS, names):
        values = getattr(columns, field)
        width = 0 if values is None else values.shape[1]
        if given is None:
            given = [f"{_PREFIX[field]}{i}" for i in range(width)]
        if len(given) != width or len(set(given)) != width:
            raise InvalidEpisodeError(
                f"{field[:-1]}_names = {list(given)}: expected {width} different names."
            )
        checked[field] = tuple(str(name) for name in given)
    return checked


def same(a: Any, b: Any) -> bool:
    """Whether two fields are equal; NaN equals NaN."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return a is b or (type(a) is type(b) and not isinstance(a, np.ndarray) and a == b)
