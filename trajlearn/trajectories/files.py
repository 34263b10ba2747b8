"""Files: ``.npz`` without pickle, and ``.parquet``; written whole or not at all."""

import json
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np

from trajlearn.exceptions import UnknownFileError
from trajlearn.trajectories._archive import FileKind, ForeignFileError, read_file, write_file
from trajlearn.trajectories._columns import EPISODE_FIELDS, STATE_FIELDS, STEP_FIELDS
from trajlearn.trajectories._extras import import_extra
from trajlearn.trajectories._flat import assemble
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.frames import build_table, column_labels

__all__ = ["load_dataset", "read_npz", "save_dataset", "write_npz"]

_KIND = FileKind("trajlearn.dataset", 1, "dataset")
# Where Parquet keeps our header, and the column that tells where an episode begins: ids repeat
# in a bootstrap sample.
_KEY, _STEP = b"trajlearn", "step"


def save_dataset(ds: TrajectoryDataset, path: str | Path) -> None:
    """Write a dataset to a ``.npz`` or ``.parquet`` file.

    The file appears under its name only when it is complete; one of the same name is replaced.
    Both kinds keep every bit. A Parquet file is the long table of `to_frame` (with a column
    ``step``), which any tool can read; where names of fields collide, columns are called
    ``states.x``, ``actions.x`` and so on.

    Parameters
    ----------
    ds : TrajectoryDataset
    path : str or Path

    Raises
    ------
    UnknownFileError
        If the suffix is neither ``.npz`` nor ``.parquet``.
    ImportError
        For Parquet without pyarrow.

    Examples
    --------
    >>> import tempfile
    >>> ds = TrajectoryDataset.from_arrays([[[0.0], [1.0]]])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_dataset(ds, folder + "/log.npz")
    ...     load_dataset(folder + "/log.npz") == ds
    True
    """
    path = Path(path)
    write = {".npz": write_npz, ".parquet": _write_parquet}[_suffix(path)]
    write_file(path, lambda handle: write(ds, handle))


def load_dataset(path: str | Path) -> TrajectoryDataset:
    """Read a file that `save_dataset` wrote; nothing in it is executed.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    TrajectoryDataset

    Raises
    ------
    UnknownFileError
        If the file is truncated, changed, of another kind or from a newer version.
    OSError
        If it is not there or cannot be opened.
    ImportError
        For Parquet without pyarrow.
    """
    path = Path(path)
    read = {".npz": read_npz, ".parquet": _read_parquet}[_suffix(path)]
    if read is _read_parquet:
        _pyarrow()
    return read_file(path, read)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix in (".npz", ".parquet"):
        return suffix
    raise UnknownFileError(
        f"{path}: the suffix {path.suffix!r} is neither '.npz' nor '.parquet'. For other tables "
        "use pandas: ds.to_frame().to_csv(path), and from_frame(pandas.read_csv(path), ...)."
    )


# -- npz: one array a field, and a JSON header ------------------------------------------------


def write_npz(ds: TrajectoryDataset, handle: IO[bytes]) -> None:
    """Write a dataset into an open file."""
    columns = ds._columns
    header = _KIND.header(
        names={field: list(names) for field, names in ds._names.items()},
        context=list(columns.context),
        params_per_step=columns.params_per_step,
        hindsight=columns.hindsight,
    )
    arrays = {"counts": np.diff(columns.offsets)}
    for field in (*STATE_FIELDS, *STEP_FIELDS, *EPISODE_FIELDS, "params"):
        if getattr(columns, field) is not None:
            arrays[field] = getattr(columns, field)
    for i, values in enumerate(columns.context.values()):
        arrays[f"context{i}"] = values
    _KIND.write_npz(handle, header, arrays)


def read_npz(handle: IO[bytes]) -> TrajectoryDataset:
    """Read from an open file what `write_npz` wrote."""
    header, arrays = _KIND.read_npz(handle)
    context = {key: arrays.pop(f"context{i}").tolist() for i, key in enumerate(header["context"])}
    group = arrays.pop("group", None)
    return assemble(
        names=header["names"],
        params_per_step=header["params_per_step"],
        hindsight=header.get("hindsight", False),
        context=context,
        ids=arrays.pop("ids").tolist(),
        group=None if group is None else group.tolist(),
        **arrays,
    )


# -- Parquet: the long table, and the same header in its metadata ---------------------------


def _pyarrow() -> tuple[Any, Any]:
    pyarrow = import_extra("pyarrow", "parquet", by="A .parquet file")
    return pyarrow, import_extra("pyarrow.parquet", "parquet", by="A .parquet file")


def _write_parquet(ds: TrajectoryDataset, handle: IO[bytes]) -> None:
    pyarrow, parquet = _pyarrow()
    labels = column_labels(ds)
    plain = [column for columns in labels.values() for column in columns] + [_STEP]
    if len(set(plain)) < len(plain):
        labels = {
            field: [f"{field}.{name}" for name in columns] for field, columns in labels.items()
        }
    header = _KIND.header(
        names={field: list(names) for field, names in ds._names.items()},
        context=list(ds.context),
        columns=labels,
        crc32=_checksum(ds),
        params_per_step=ds.params_vary,
        hindsight=ds.hindsight,
    )
    frame = build_table(ds, labels, ds.ids)
    position = np.arange(len(frame)) - np.repeat(ds.offsets[:-1], ds.lengths + 1)
    frame.insert(1, _STEP, position)
    table = pyarrow.Table.from_pandas(frame, preserve_index=False)
    metadata = (table.schema.metadata or {}) | {_KEY: json.dumps(header).encode()}
    parquet.write_table(table.replace_schema_metadata(metadata), handle, write_page_checksum=True)


def _read_parquet(handle: IO[bytes]) -> TrajectoryDataset:
    _, parquet = _pyarrow()
    file = parquet.ParquetFile(handle, page_checksum_verification=True)
    metadata = file.schema_arrow.metadata or {}
    if _KEY not in metadata:
        raise ForeignFileError(
            "this Parquet file was not saved by trajlearn. For a table of your own use "
            "from_frame(pandas.read_parquet(path), ...)."
        )
    header = _KIND.checked(json.loads(metadata[_KEY]))
    table, labels = file.read(), header["columns"]

    def values(column: str) -> Any:
        return table.column(column).to_numpy()

    def stacked(field: str, rows: Any) -> Any:
        if field not in labels:
            return None
        return np.column_stack([values(column)[rows] for column in labels[field]])

    step = values(_STEP)
    starts = np.flatnonzero(step == 0)
    counts = np.diff(np.append(starts, len(step)))
    if len(step) and step[0] != 0:
        raise ValueError("rows are missing")
    if not np.array_equal(step, np.arange(len(step)) - np.repeat(starts, counts)):
        raise ValueError("rows are missing or out of order")
    is_step = np.ones(len(step), dtype=bool)
    is_step[starts + counts - 1] = False
    every, per_step = slice(None), header["params_per_step"]
    rewards = stacked("rewards", is_step)

    def by_episode(field: str, default: Any) -> Any:
        return values(labels[field][0])[starts].tolist() if field in labels else default

    ds = assemble(
        names=header["names"],
        counts=counts,
        ids=by_episode("episode", None),
        states=stacked("states", every),
        times=values(labels["time"][0]),
        actions=stacked("actions", is_step),
        rewards=None if rewards is None else rewards[:, 0],
        params=stacked("params", is_step if per_step else starts),
        params_per_step=per_step,
        # files of earlier versions have no such entry
        hindsight=header.get("hindsight", False),
        references=stacked("references", every),
        observed=stacked("observed", every),
        group=by_episode("group", None),
        context={
            key: values(column)[starts].tolist()
            for key, column in zip(header["context"], labels.get("context", []), strict=True)
        },
        terminated=by_episode("terminated", [False] * len(counts)),
        time_origin=by_episode("time_origin", [np.nan] * len(counts)),
    )
    if _checksum(ds) != header["crc32"]:
        raise ValueError("the contents do not match their checksum")
    return ds


def _checksum(ds: TrajectoryDataset) -> int:
    """Of everything in the dataset: Parquet guards its pages, but not its footer."""
    labels = [ds._names, ds.ids.tolist(), ds.group if ds.group is None else ds.group.tolist()]
    labels += [(key, values.tolist()) for key, values in ds.context.items()]
    if ds.hindsight:
        labels.append("hindsight")
    total = zlib.crc32(repr(labels).encode())
    columns = ds._columns
    for values in (
        *(getattr(columns, field) for field in (*STATE_FIELDS, *STEP_FIELDS, "params")),
        columns.offsets.astype(np.int64),
        columns.terminated,
        np.where(np.isnan(columns.time_origin), np.nan, columns.time_origin),
    ):
        total = zlib.crc32(b"" if values is None else np.ascontiguousarray(values).data, total)
    return total
