"""A dataset from flat arrays and episode lengths: the door for tables and files."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._arrays import check_names
from trajlearn.trajectories._columns import (
    VECTOR_FIELDS,
    Columns,
    _check_values,
    _offsets,
    _plain,
)
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["assemble"]


def assemble(
    *,
    counts: NDArray[np.intp],
    ids: Sequence[Any],
    names: Mapping[str, Sequence[str] | None],
    states: ArrayLike,
    times: ArrayLike,
    terminated: ArrayLike,
    time_origin: ArrayLike,
    actions: ArrayLike | None = None,
    rewards: ArrayLike | None = None,
    params: ArrayLike | None = None,
    params_per_step: bool = False,
    references: ArrayLike | None = None,
    observed: ArrayLike | None = None,
    hindsight: bool = False,
    group: Sequence[Any] | None = None,
    context: Mapping[str, Sequence[Any]] | None = None,
) -> TrajectoryDataset:
    """Validate flat arrays, episode after episode, and make a dataset of them (not of copies).

    Parameters
    ----------
    counts : ndarray of shape (n,)
        States in each episode.
    ids : sequence of n labels
    names : mapping from field to column names
    states, times, references, observed : array-like with one row a state
    actions, rewards : array-like with one row a step
    params : array-like with one row a step if `params_per_step`, else one an episode
    terminated, time_origin, group, context : one value an episode
    hindsight : bool

    Raises
    ------
    InvalidEpisodeError
        On anything that no model could use; the message names the episode.
    """
    n = len(counts)
    if not n:
        raise InvalidEpisodeError("there are no rows: a dataset needs at least one episode.")
    short = np.flatnonzero(counts < 2)
    if len(short):
        raise InvalidEpisodeError(
            f"episode {ids[short[0]]}: has {counts[short[0]]} row(s); an episode needs at least "
            "2 (s_0 and s_1). Leave it out or log it longer."
        )
    n_states, n_steps = int(counts.sum()), int(counts.sum()) - n
    floats: dict[str, Any] = {}
    for name, value, ndim, rows in (
        ("states", states, 2, n_states),
        ("times", times, 1, n_states),
        ("references", references, 2, n_states),
        ("observed", observed, 2, n_states),
        ("actions", actions, 2, n_steps),
        ("rewards", rewards, 1, n_steps),
        ("params", params, 2, n_steps if params_per_step else n),
        ("time_origin", time_origin, 1, n),
    ):
        if value is None:
            continue
        array = np.ascontiguousarray(value, dtype=np.float64)
        if array.ndim != ndim or len(array) != rows or (ndim == 2 and not array.shape[1]):
            raise InvalidEpisodeError(
                f"{name} has shape {array.shape}; the episodes need {rows} rows."
            )
        floats[name] = array
    columns = Columns(
        offsets=_offsets(np.asarray(counts, dtype=np.intp)),
        ids=_plain(ids, "episode id", range(n)),
        terminated=np.array(terminated, dtype=bool).reshape(n),
        group=None if group is None else _plain(group, "group", ids),
        context={
            str(key): _plain(values, f"context {key!r}", ids)
            for key, values in (context or {}).items()
        },
        params_per_step=params_per_step,
        hindsight=hindsight,
        **floats,
    )
    if any(len(values) != n for values in (columns.ids, *columns.context.values())):
        raise InvalidEpisodeError(f"labels must have one value for each of the {n} episodes.")
    if columns.group is not None and len(columns.group) != n:
        raise InvalidEpisodeError(f"group has {len(columns.group)} values for {n} episodes.")
    _check_values(columns, ids)
    columns = columns.canonical().freeze()
    checked = check_names(columns, *map(names.get, VECTOR_FIELDS))
    if columns.observed is not None:
        checked["observed"] = tuple(str(name) for name in names.get("observed") or ())
        if len(set(checked["observed"])) != columns.observed.shape[1]:
            raise InvalidEpisodeError(
                f"observed has {columns.observed.shape[1]} columns, but the names "
                f"{list(checked['observed'])}."
            )
    return TrajectoryDataset._of(columns, checked)
