"""One file for a search: ``.npz`` without pickle, written whole or not at all."""

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._trials import Proposal, Trials
from trajlearn.exceptions import UnknownFileError
from trajlearn.trajectories.files import _read_npz, _replace, _write_npz

__all__ = ["read_search", "write_search"]

_FORMAT, _VERSION = "trajlearn.search", 1
_RECORD = "record."


def write_search(path: str | Path, name: str, state: Trials) -> None:
    """Write the state of a search of the class `name`; a file of that path is replaced."""
    header: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "class": name,
        "seed": state.seed,
        "horizon": state.horizon,
        "n_asked": state.n_asked,
    }
    arrays: dict[str, NDArray[Any]] = {"bounds": state.bounds}
    if state.pending is not None:
        # Python's JSON keeps every bit of a float
        header["pending"] = asdict(state.pending) | {"params": state.pending.params.tolist()}
    if state.last is not None:
        arrays["last"] = state.last
    if state.data is not None:
        buffer = io.BytesIO()
        _write_npz(state.data, buffer)
        arrays["trials"] = np.frombuffer(buffer.getvalue(), dtype=np.uint8)
        arrays |= {f"{_RECORD}{key}": values for key, values in state.records.items()}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)

    def write(handle: IO[bytes]) -> None:
        np.savez(handle, allow_pickle=False, **arrays)

    _replace(Path(path), write)


def read_search(path: str | Path) -> tuple[str, Trials]:
    """Class name and state of a search; nothing in the file is executed.

    Raises
    ------
    FileNotFoundError
        If it is not there.
    UnknownFileError
        If it is truncated, changed, or of another kind.
    """
    with Path(path).open("rb") as handle:
        try:
            return _read(handle)
        except _Foreign as error:
            raise UnknownFileError(f"{path}: {error}") from error
        # as for datasets: a damaged file fails in any of a dozen ways
        except Exception as error:
            raise UnknownFileError(
                f"{path} is damaged: truncated, or changed after it was saved "
                f"({type(error).__name__}: {error})."
            ) from error


class _Foreign(Exception):
    """A sound file that is not of a search."""


def _read(handle: IO[bytes]) -> tuple[str, Trials]:
    archive = np.load(handle, allow_pickle=False)
    if not isinstance(archive, np.lib.npyio.NpzFile) or "header" not in archive.files:
        raise _Foreign("this is not a search that trajlearn saved.")
    with archive:
        arrays = {key: archive[key] for key in archive.files}
    header = json.loads(arrays["header"].tobytes())
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise _Foreign("this is not a search that trajlearn saved.")
    if header.get("version") != _VERSION:
        raise _Foreign(
            f"the file has version {header.get('version')!r} of the format, this package reads "
            f"{_VERSION}. Use the version of trajlearn that wrote it, or a newer one."
        )
    pending = header.get("pending")
    if pending is not None:
        pending = Proposal(**pending | {"params": np.array(pending["params"], dtype=np.float64)})
    trials = arrays.get("trials")
    state = Trials(
        seed=int(header["seed"]),
        bounds=arrays["bounds"],
        horizon=int(header["horizon"]),
        n_asked=int(header["n_asked"]),
        pending=pending,
        last=arrays.get("last"),
        data=None if trials is None else _read_npz(io.BytesIO(trials.tobytes())),
        records={
            key.removeprefix(_RECORD): values
            for key, values in arrays.items()
            if key.startswith(_RECORD)
        },
    )
    if any(len(values) != len(state) for values in state.records.values()):
        raise ValueError("the records do not match the trials")
    return header["class"], state
