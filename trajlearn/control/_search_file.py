"""One file for a search: ``.npz`` without pickle, written whole or not at all."""

import io
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.control._trials import Proposal, Trials
from trajlearn.trajectories._archive import FileKind, read_file, write_file
from trajlearn.trajectories.files import read_npz, write_npz

__all__ = ["read_search", "taken_up", "write_search"]

_KIND = FileKind("trajlearn.search", 1, "search")
_RECORD = "record."


def write_search(path: str | Path, name: str, state: Trials) -> None:
    """Write the state of a search of the class `name`; a file of that path is replaced."""
    header = _KIND.header(
        seed=state.seed, horizon=state.horizon, n_asked=state.n_asked, **{"class": name}
    )
    arrays: dict[str, NDArray[Any]] = {"bounds": state.bounds}
    if state.pending is not None:
        # Python's JSON keeps every bit of a float
        header["pending"] = asdict(state.pending) | {"params": state.pending.params.tolist()}
    if state.last is not None:
        arrays["last"] = state.last
    if state.data is not None:
        buffer = io.BytesIO()
        write_npz(state.data, buffer)
        arrays["trials"] = np.frombuffer(buffer.getvalue(), dtype=np.uint8)
        arrays |= {f"{_RECORD}{key}": values for key, values in state.records.items()}
    write_file(Path(path), lambda handle: _KIND.write_npz(handle, header, arrays))


def read_search(path: str | Path) -> tuple[str, Trials]:
    """Class name and state of a search; nothing in the file is executed.

    Raises
    ------
    FileNotFoundError
        If it is not there.
    UnknownFileError
        If it is truncated, changed, or of another kind.
    """
    return read_file(Path(path), _read)


def _read(handle: IO[bytes]) -> tuple[str, Trials]:
    header, arrays = _KIND.read_npz(handle)
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
        data=None if trials is None else read_npz(io.BytesIO(trials.tobytes())),
        records={
            key.removeprefix(_RECORD): values
            for key, values in arrays.items()
            if key.startswith(_RECORD)
        },
    )
    if any(len(values) != len(state) for values in state.records.values()):
        raise ValueError("the records do not match the trials")
    return header["class"], state


def taken_up(mine: Trials, found: Trials, path: str | Path) -> tuple[Trials, int]:
    """What to go on from, the state of a search or of its file, and how many proposals were made.

    Raises
    ------
    ValueError
        If the trials of one are not the first of the other.
    """
    n = min(len(mine), len(found))
    if n:
        assert mine.data is not None
        assert found.data is not None
        old, new = mine.data[:n], found.data[:n]
        if not (
            np.array_equal(old.offsets, new.offsets) and np.array_equal(old.states, new.states)
        ):
            raise ValueError(
                f"{path} holds a search with other trials than this one: give another path, or "
                "resume(path) in a new search."
            )
    if len(found) < len(mine) or found.n_asked < mine.n_asked:
        return mine, 0
    # a proposal that waits for its trial is still to be run
    ahead = [state.n_asked - (state.pending is not None) for state in (found, mine)]
    return found, max(ahead[0] - ahead[1], 0)
