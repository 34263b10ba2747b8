"""Long tables (pandas): one row a state, and the summary of a dataset."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._flat import assemble
from trajlearn.trajectories._table import LongTable, check_roles, listed
from trajlearn.trajectories.dataset import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["describe", "from_frame", "to_frame"]


def from_frame(
    frame: "pd.DataFrame",
    *,
    episode: str,
    time: str | None = None,
    dt: float = 1.0,
    states: str | Sequence[str],
    actions: str | Sequence[str] = (),
    rewards: str | None = None,
    params: str | Sequence[str] = (),
    references: str | Sequence[str] = (),
    context: str | Sequence[str] = (),
    group: str | None = None,
    terminated: str | None = None,
    time_origin: str | None = None,
) -> TrajectoryDataset:
    """Dataset from a long table, one row a step.

    Row t of an episode holds s_t and the action a_t applied there. The last row is the final
    state s_T: its action, reward and params belong to no step, are ignored and may be missing.

    Parameters
    ----------
    frame : DataFrame
        Read from CSV, Parquet or anything else that pandas reads.
    episode : str
        Column that tells the episodes apart; its values become `ids`, in order of first
        appearance. Rows of several episodes may alternate if `time` is given.
    time : str, optional
        Column of times, in any unit, increasing strictly within an episode. Rows are never
        sorted by it: an order that does not increase is an error.
    dt : float, default=1.0
        Sampling time where `time` is not given.
    states, actions, params, references : str or sequence of str
        Columns of numbers. Their names become those of the dataset. `params` may change
        within an episode.
    rewards : str, optional
        Column with the reward of the step from the row's state to the next.
    context, group, terminated, time_origin : str (`context`: or sequence of str), optional
        Columns with one value an episode, repeated on its rows. Whole numbers that a file
        keeps as floats are read as integers. A missing `time_origin` means unknown.

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    ValueError
        Columns that are not in the table (all are named), or that serve two purposes.
    InvalidEpisodeError
        Missing or non-finite values, text among numbers, unsorted times, too short episodes,
        labels that change within an episode; the message names the episode.

    Examples
    --------
    >>> import pandas as pd
    >>> log = pd.DataFrame(
    ...     {
    ...         "flight": ["a", "a", "a", "b", "b"],
    ...         "t": [0.0, 0.1, 0.2, 0.0, 0.1],
    ...         "height": [0.0, 0.5, 0.9, 0.1, 0.4],
    ...         "thrust": [1.0, 0.8, None, 0.9, None],
    ...         "gain": [2.0, 2.0, 2.0, 3.0, 3.0],
    ...     }
    ... )
    >>> ds = from_frame(
    ...     log, episode="flight", time="t", states=["height"], actions=["thrust"], params=["gain"]
    ... )
    >>> ds
    TrajectoryDataset(n=2, steps=1..2, d_s=1, d_a=1, p=1)
    >>> ds["b" == ds.ids].params
    array([[3.]])
    """
    roles = {
        "episode": listed(episode),
        "time": listed(time),
        "states": listed(states),
        "actions": listed(actions),
        "rewards": listed(rewards),
        "params": listed(params),
        "references": listed(references),
        "context": listed(context),
        "group": listed(group),
        "terminated": listed(terminated),
        "time_origin": listed(time_origin),
    }
    check_roles(frame, roles)
    table = LongTable(frame, episode, has_time=time is not None)
    facts = {str(key): table.labels(key, "context") for key in roles["context"]}
    n = len(table.counts)
    if time is not None:
        times = table.floats([time], "time")[:, 0]
    elif not (np.isfinite(dt) and dt > 0):
        raise InvalidEpisodeError(f"dt = {dt} must be positive and finite.")
    else:
        times = np.asarray(table.position * float(dt))
    return assemble(
        counts=table.counts,
        ids=table.ids,
        states=table.floats(roles["states"], "states"),
        times=times,
        actions=table.steps(roles["actions"], "actions"),
        rewards=table.steps([rewards], "rewards")[:, 0] if rewards is not None else None,
        params=table.steps(roles["params"], "params"),
        params_per_step=bool(roles["params"]),
        references=table.floats(refs, "references") if (refs := roles["references"]) else None,
        group=None if group is None else table.labels(group, "group"),
        context=facts,
        terminated=[False] * n if terminated is None else table.flags(terminated),
        time_origin=[np.nan] * n if time_origin is None else table.origins(time_origin),
        names={
            field: [str(name) for name in roles[field]]
            for field in ("states", "actions", "params", "references")
        },
    )


def column_labels(ds: TrajectoryDataset) -> dict[str, list[str]]:
    """Columns of the long table by field; absent fields are left out."""
    labels = {
        "episode": ["episode"],
        "time": ["time"],
        "states": list(ds.state_names),
        "actions": list(ds.action_names),
        "rewards": ["reward"] if ds.rewards is not None else [],
        "params": list(ds.param_names),
        "references": list(ds.reference_names),
        "observed": [f"observed_{name}" for name in ds.observed_names],
        "context": list(ds.context),
        "group": ["group"] if ds.group is not None else [],
        "terminated": ["terminated"] if ds.terminated.any() else [],
        "time_origin": ["time_origin"] if np.isfinite(ds.time_origin).any() else [],
    }
    return {field: columns for field, columns in labels.items() if columns}


def to_frame(ds: TrajectoryDataset) -> "pd.DataFrame":
    """Long table of a dataset, one row a state.

    Parameters
    ----------
    ds : TrajectoryDataset

    Returns
    -------
    DataFrame
        Columns ``episode``, ``time``, the names of the states, actions, params and references,
        ``reward``, ``observed_<name>`` (where a transformer estimated the states), the names of
        the context, and ``group``, ``terminated`` (if any episode is) and ``time_origin`` (if
        any is known). Actions, rewards and changing params are NaN in the last row of an
        episode, to which no step belongs. `from_frame` gives the dataset back (without
        `observed`). Where ids repeat (a bootstrap sample), episodes are numbered instead.

    Raises
    ------
    ValueError
        If two columns would have the same name.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[1.0], [2.0]]], actions=[[[0.5]]], dt=0.1)
    >>> to_frame(ds)
       episode  time   s0   a0
    0        0   0.0  1.0  0.5
    1        0   0.1  2.0  NaN
    """
    labels = column_labels(ds)
    uses: dict[str, list[str]] = {}
    for field, columns in labels.items():
        for column in columns:
            uses.setdefault(column, []).append(field)
    twice = {column: fields for column, fields in uses.items() if len(fields) > 1}
    if twice:
        listed = ", ".join(f"{column!r} ({' and '.join(f)})" for column, f in twice.items())
        raise ValueError(
            f"a table cannot have two columns of one name: {listed}. Build the dataset with other "
            "names (state_names=, action_names=, ...)."
        )
    ids = ds.ids if len(np.unique(ds.ids)) == len(ds) else np.arange(len(ds))
    return build_table(ds, labels, ids)


def build_table(
    ds: TrajectoryDataset, labels: Mapping[str, Sequence[str]], ids: NDArray[Any]
) -> "pd.DataFrame":
    """Long table with the given column labels and episode ids."""
    import pandas as pd

    counts = ds.lengths + 1
    episode = np.repeat(np.arange(len(ds)), counts)
    is_step = np.ones(len(episode), dtype=bool)
    is_step[ds.offsets[1:] - 1] = False

    def by_episode(values: NDArray[Any]) -> Any:
        return pd.Series(values.tolist()).array.take(episode)

    def by_step(values: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.full((len(episode), *values.shape[1:]), np.nan)
        out[is_step] = values
        return out

    values: dict[str, list[Any]] = {
        "episode": [by_episode(ids)],
        "time": [ds.times],
        "states": list(ds.states.T),
        "context": [by_episode(item) for item in ds.context.values()],
        "terminated": [ds.terminated[episode]],
        "time_origin": [ds.time_origin[episode]],
    }
    if ds.actions is not None:
        values["actions"] = list(by_step(ds.actions).T)
    if ds.rewards is not None:
        values["rewards"] = [by_step(ds.rewards)]
    if ds.references is not None:
        values["references"] = list(ds.references.T)
    if ds.observed is not None:
        values["observed"] = list(ds.observed.T)
    if ds.group is not None:
        values["group"] = [by_episode(ds.group)]
    if (params := ds.step_params) is not None:
        params = by_step(params) if ds.params_vary else ds.params_at()[episode]
        values["params"] = list(params.T)
    return pd.DataFrame(
        {
            column: array
            for field, columns in labels.items()
            for column, array in zip(columns, values[field], strict=True)
        }
    )


def describe(ds: TrajectoryDataset) -> "pd.DataFrame":
    """Summary of a dataset, one row a column of every field.

    Parameters
    ----------
    ds : TrajectoryDataset

    Returns
    -------
    DataFrame
        Indexed by field and name; columns ``count`` (of values), ``mean``, ``std`` (divided by
        the count), ``min``, ``max``, and ``distinct``, the number of different values of labels
        and of constant params. The first rows are the steps in an episode and the time step.

    Examples
    --------
    >>> ds = TrajectoryDataset.from_arrays([[[1.0], [3.0]], [[1.0], [2.0], [3.0]]], group="ab")
    >>> describe(ds)
                    count  mean       std  min  max  distinct
    field   name
    episode steps       2   1.5  0.500000  1.0  2.0      <NA>
    times   dt          3   1.0  0.000000  1.0  1.0      <NA>
    states  s0          5   2.0  0.894427  1.0  3.0      <NA>
    group   group       2   NaN       NaN  NaN  NaN         2
    """
    import pandas as pd

    last = np.zeros(len(ds.times), dtype=bool)
    last[ds.offsets[1:] - 1] = True
    known = ds.time_origin[np.isfinite(ds.time_origin)]
    rows: list[tuple[str, str, Any]] = [
        ("episode", "steps", ds.lengths),
        ("times", "dt", np.diff(ds.times)[~last[:-1]]),
    ]
    params = ds.step_params if ds.params_vary else (ds.params if ds.has_params else None)
    for field, names, values in (
        ("states", ds.state_names, ds.states),
        ("actions", ds.action_names, ds.actions),
        ("rewards", ("reward",), None if ds.rewards is None else ds.rewards[:, None]),
        ("params", ds.param_names, params),
        ("references", ds.reference_names, ds.references),
        ("observed", ds.observed_names, ds.observed),
        ("time_origin", ("time_origin",), known[:, None] if len(known) else None),
        ("terminated", ("terminated",), ds.terminated[:, None] if ds.terminated.any() else None),
    ):
        if values is not None:
            rows += [(field, name, values[:, j]) for j, name in enumerate(names)]
    rows += [("context", key, values) for key, values in ds.context.items()]
    rows += [] if ds.group is None else [("group", "group", ds.group)]
    records = []
    for field, _, values in rows:
        record: dict[str, Any] = {"count": len(values)}
        if field not in ("context", "group"):
            numbers = np.asarray(values, dtype=np.float64)
            record |= {"mean": numbers.mean(), "std": numbers.std()}
            record |= {"min": numbers.min(), "max": numbers.max()}
        if field in ("context", "group") or (field == "params" and not ds.params_vary):
            record["distinct"] = len(np.unique(values))
        records.append(record)
    index = pd.MultiIndex.from_tuples([row[:2] for row in rows], names=["field", "name"])
    columns = ["count", "mean", "std", "min", "max", "distinct"]
    return pd.DataFrame(records, index=index, columns=columns).astype({"distinct": "Int64"})
