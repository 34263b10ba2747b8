"""New datasets from old ones: cut, select, add noise, join."""

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_random_state, check_scalar

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._arrays import unique_ids
from trajlearn.trajectories._columns import VECTOR_FIELDS, Columns, _offsets, runs
from trajlearn.trajectories._pieces import cut, like, pieces
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.resampling import decimate, resample

__all__ = [
    "add_noise",
    "assign",
    "concatenate",
    "decimate",
    "resample",
    "select_states",
    "truncate",
    "window",
]


def truncate(ds: TrajectoryDataset, max_steps: int) -> TrajectoryDataset:
    """At most the first `max_steps` steps of each episode.

    An episode cut short is no longer `terminated`; everything else is kept.

    Parameters
    ----------
    ds : TrajectoryDataset
    max_steps : int

    Returns
    -------
    TrajectoryDataset

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[0.0]] * 4, [[0.0]] * 9])
    >>> truncate(ds, 5).lengths
    array([3, 5])
    """
    check_scalar(max_steps, "max_steps", Integral, min_val=1)
    episode = np.arange(len(ds))
    steps = np.minimum(ds.lengths, max_steps)
    return like(ds, cut(ds._columns, episode, np.zeros_like(episode), steps))


def window(ds: TrajectoryDataset, length: int, *, stride: int | None = None) -> TrajectoryDataset:
    """Windows of `length` steps (``length + 1`` states), every `stride` steps.

    With the default stride (`length`) they tile the episode; neighbours share one state. Times
    and `time_origin` stay as logged. A tail shorter than `length` is left out; only the window
    that reaches the end of a terminated episode is `terminated`. Windows are called
    ``"<id>:<start>"``. Where the dataset has no `group`, the windows get the id of their episode
    as group, so that group splits never part them.

    Parameters
    ----------
    ds : TrajectoryDataset
    length : int
    stride : int, optional
        Steps from the start of a window to that of the next; default `length`.

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    InvalidEpisodeError
        If no episode has `length` steps.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[0.0]] * 4, [[0.0]] * 9], ids=["a", "b"])
    >>> window(ds, 3).ids.tolist()
    ['a:0', 'b:0', 'b:3']
    """
    check_scalar(length, "length", Integral, min_val=1)
    stride = length if stride is None else stride
    check_scalar(stride, "stride", Integral, min_val=1)
    counts = np.maximum((ds.lengths - length) // stride + 1, 0)
    if not counts.any():
        raise InvalidEpisodeError(
            f"no episode has {length} steps (the longest has {ds.lengths.max()}): ask for shorter "
            "windows."
        )
    episode = np.repeat(np.arange(len(ds)), counts)
    start = runs(np.zeros(len(ds), dtype=np.intp), counts, stride)
    return like(ds, pieces(ds._columns, episode, start, np.full_like(start, length)))


def select_states(ds: TrajectoryDataset, names: Sequence[str]) -> TrajectoryDataset:
    """Keep the named state columns, in that order; `observed` stays as it is.

    Parameters
    ----------
    ds : TrajectoryDataset
    names : sequence of str

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    ValueError
        If a name is unknown or repeated, or none is given.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[1.0, 2.0]] * 3], state_names=["x", "v"])
    >>> select_states(ds, ["v"]).states.ravel()
    array([2., 2., 2.])
    """
    chosen = [names] if isinstance(names, str) else list(names)
    for name in chosen:
        if name not in ds.state_names:
            close = get_close_matches(str(name), ds.state_names, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            raise ValueError(
                f"there is no state called {name!r}; the states are {list(ds.state_names)}.{hint}"
            )
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"names = {chosen}: give at least one state, and each once.")
    index = [ds.state_names.index(name) for name in chosen]
    columns = replace(ds._columns, states=np.ascontiguousarray(ds.states[:, index]))
    return TrajectoryDataset._of(columns.freeze(), ds._names | {"states": tuple(chosen)})


def add_noise(
    ds: TrajectoryDataset,
    fraction: float,
    *,
    of: Literal["std", "range"] = "std",
    random_state: Any = None,
) -> TrajectoryDataset:
    """Add independent Gaussian measurement noise to every state, and to nothing else.

    Parameters
    ----------
    ds : TrajectoryDataset
    fraction : float
        Standard deviation of the noise as a fraction of each state column's spread over the
        whole dataset.
    of : {"std", "range"}, default="std"
        What the spread is: standard deviation, or maximum minus minimum.
    random_state : int, RandomState instance or None

    Returns
    -------
    TrajectoryDataset

    Examples
    --------
    >>> import numpy as np
    >>> ds = TrajectoryDataset.from_arrays([np.arange(1000.0)[:, None]])
    >>> noisy = add_noise(ds, 0.1, of="range", random_state=0)
    >>> print(f"{(noisy.states - ds.states).std():.0f}")
    99
    """
    check_scalar(fraction, "fraction", Real, min_val=0)
    if not np.isfinite(fraction):
        raise ValueError(f"fraction = {fraction} must be finite.")
    if of not in ("std", "range"):
        raise ValueError(f"of = {of!r}: choose 'std' or 'range'.")
    spread = ds.states.std(axis=0) if of == "std" else np.ptp(ds.states, axis=0)
    noise = check_random_state(random_state).standard_normal(ds.states.shape)
    return like(ds, replace(ds._columns, states=ds.states + fraction * spread * noise))


def concatenate(ds: TrajectoryDataset, *others: TrajectoryDataset) -> TrajectoryDataset:
    """Episodes of several datasets, one after the other.

    Ids are kept if they still tell all episodes apart; else the episodes are numbered.

    Parameters
    ----------
    ds, *others : TrajectoryDataset

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    ValueError
        If the datasets have not the same fields, column names, context and kind of group.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[0.0]] * 4, [[0.0]] * 9])
    >>> concatenate(ds, ds).ids
    array([0, 1, 2, 3])
    """
    for position, other in enumerate(others, start=2):
        if not isinstance(other, TrajectoryDataset):
            raise TypeError(f"concatenate joins datasets, got {type(other).__name__}.")
        mine, theirs = _fields(ds), _fields(other)
        for field in mine:
            if mine[field] != theirs[field]:
                raise ValueError(
                    f"the datasets differ in {field}: {mine[field]} in the first, {theirs[field]} "
                    f"in number {position}. Give them the same fields and names."
                )
    parts = [item._columns for item in (ds, *others)]
    per_step = any(part.params_per_step for part in parts)
    joined: dict[str, Any] = {
        "params_per_step": per_step,
        "hindsight": any(part.hindsight for part in parts),
    }
    for name in (
        "states",
        "times",
        "references",
        "observed",
        "actions",
        "rewards",
        "terminated",
        "time_origin",
        "group",
    ):
        if getattr(parts[0], name) is not None:
            joined[name] = np.concatenate([getattr(part, name) for part in parts])
    if parts[0].params is not None:
        joined["params"] = np.concatenate(
            [item.step_params if per_step else item.params for item in (ds, *others)]
        )
    joined["offsets"] = _offsets(np.concatenate([part.lengths + 1 for part in parts]))
    ids = [label for part in parts for label in part.ids.tolist()]
    if len({type(label) for label in ids}) > 1:
        ids = [str(label) for label in ids]
    joined["ids"] = np.array(unique_ids(ids))
    joined["context"] = {
        key: np.concatenate([part.context[key] for part in parts]) for key in parts[0].context
    }
    return like(ds, Columns(**joined))


def assign(ds: TrajectoryDataset, **fields: Any) -> TrajectoryDataset:
    """The same episodes with some fields replaced: other gains, another reference.

    Parameters
    ----------
    ds : TrajectoryDataset
    **fields
        As in `TrajectoryDataset.from_arrays`, apart from ``states`` and ``dt``: ``actions``,
        ``rewards``, ``params``, ``references``, ``times``, ``time_origin``, ``context``,
        ``group``, ``terminated``, ``ids``, and the names of columns. None removes a field.
        ``params`` of shape (p,) and ``context`` values that are no lists are meant for all
        episodes; ``context`` replaces all that there is. Names stay where the number of columns
        does.

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    TypeError
        For an unknown field.
    InvalidEpisodeError
        Where a new field does not fit the episodes.

    Examples
    --------
    What would other gains have done? A model that was fitted with gains can say.

    >>> ds = TrajectoryDataset.from_arrays([[[0.0]] * 4, [[0.0]] * 9], params=[[1.0], [2.0]])
    >>> assign(ds, params=[5.0]).params
    array([[5.],
           [5.]])
    """
    unknown = set(fields) - _ASSIGNABLE
    if unknown:
        raise TypeError(
            f"assign got {sorted(unknown)}; it takes {sorted(_ASSIGNABLE)}. Other states are other "
            "episodes: build them with from_arrays."
        )
    kept: dict[str, Any] = {
        name: getattr(ds, name) for name in ("time_origin", "context", "group", "terminated", "ids")
    }
    for name in ("actions", "rewards", "references", "times"):
        kept[name] = None if getattr(ds, name) is None else [getattr(e, name) for e in ds]
    kept["params"] = [e.params for e in ds] if ds.params_vary else ds.params
    new = dict(fields)
    params = new.get("params")
    if params is not None and not _ragged(params) and np.ndim(params) < 2:
        if np.shape(params) != (len(ds.param_names),) and ds.has_params:
            raise InvalidEpisodeError(
                f"params has shape {np.shape(params)}: give {len(ds.param_names)} for all episodes "
                f"({', '.join(ds.param_names)}), or {len(ds)} rows of them."
            )
        new["params"] = np.tile(np.asarray(params, dtype=np.float64), (len(ds), 1))
    for key, values in (new.get("context") or {}).items():
        if np.ndim(values) == 0:
            new["context"] = dict(new["context"]) | {key: [values] * len(ds)}
    names = {key: value for key, value in ds.names.items() if key != "state_names"}
    for key in list(names):
        field = f"{key.removesuffix('_names')}s"
        if field in new and _width(new[field]) != len(names[key]):
            del names[key]
    changed = TrajectoryDataset.from_arrays(
        [episode.states for episode in ds],
        state_names=ds.state_names,
        **{**names, **kept, **new},
    )
    if ds.observed is None:
        return changed
    columns = replace(changed._columns, observed=ds.observed, hindsight=ds.hindsight)
    return TrajectoryDataset._of(columns, changed._names | {"observed": ds.observed_names})


_ASSIGNABLE = {
    "action_names",
    "actions",
    "context",
    "group",
    "ids",
    "param_names",
    "params",
    "reference_names",
    "references",
    "rewards",
    "terminated",
    "time_origin",
    "times",
}


def _ragged(values: Any) -> bool:
    return isinstance(values, (list, tuple)) and any(np.ndim(item) for item in values)


def _width(values: Any) -> int:
    """Columns of a field by episode, 0 where there is none."""
    if values is None or not len(values):
        return 0
    return int(np.shape(values[0])[-1]) if np.ndim(values[0]) else 0


def _fields(ds: TrajectoryDataset) -> dict[str, Any]:
    return {
        **{f"{field[:-1]}_names": list(ds._names[field]) for field in VECTOR_FIELDS},
        "observed": list(ds.observed_names),
        "rewards": "given" if ds.rewards is not None else "missing",
        "context": {key: _kind(values) for key, values in ds.context.items()},
        "group": None if ds.group is None else _kind(ds.group),
    }


def _kind(values: NDArray[Any]) -> str:
    return {"b": "booleans", "i": "whole numbers", "u": "whole numbers"}.get(
        values.dtype.kind, "text"
    )
