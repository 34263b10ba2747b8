"""Files written whole or not at all, and refused unless they are whole and of their kind."""

import json
import os
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import UnknownFileError

__all__ = ["FileKind", "ForeignFileError", "read_file", "write_file"]

T = TypeVar("T")


class ForeignFileError(Exception):
    """A sound file that is not ours."""


@dataclass(frozen=True)
class FileKind:
    """What files of a kind say of themselves, in a JSON header.

    Attributes
    ----------
    format : str
    version : int
    noun : str
        What is in the file, for messages.
    """

    format: str
    version: int
    noun: str

    def header(self, **entries: Any) -> dict[str, Any]:
        """Header of a new file."""
        return {"format": self.format, "version": self.version, **entries}

    def checked(self, header: Any) -> dict[str, Any]:
        """A header, if it is of this kind and of a version that can be read."""
        if not isinstance(header, dict) or header.get("format") != self.format:
            raise ForeignFileError(f"this is not a {self.noun} that trajlearn saved.")
        if header.get("version") != self.version:
            raise ForeignFileError(
                f"the file has version {header.get('version')!r} of the format, this package reads "
                f"{self.version}. Use the version of trajlearn that wrote it, or a newer one."
            )
        return header

    def write_npz(
        self, handle: IO[bytes], header: dict[str, Any], arrays: dict[str, NDArray[Any]]
    ) -> None:
        """Write arrays, none of them called "header", and a header; without pickle."""
        text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        np.savez(handle, allow_pickle=False, **{"header": text, **arrays})

    def read_npz(self, handle: IO[bytes]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Header and arrays; nothing in the file is executed."""
        archive = np.load(handle, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile) or "header" not in archive.files:
            raise ForeignFileError(f"this is not a {self.noun} that trajlearn saved.")
        with archive:
            arrays = {name: archive[name] for name in archive.files}
        return self.checked(json.loads(arrays.pop("header").tobytes())), arrays


def write_file(path: Path, write: Callable[[IO[bytes]], None]) -> None:
    """Write beside `path` and move into place, so that no reader sees half a file."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as handle:
            write(handle)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_file(path: Path, read: Callable[[IO[bytes]], T]) -> T:
    """What `read` makes of a file.

    Raises
    ------
    UnknownFileError
        If the file is truncated, changed, of another kind or from a newer version.
    OSError
        If it is not there or cannot be opened.
    """
    with path.open("rb") as handle:
        try:
            return read(handle)
        except ForeignFileError as error:
            raise UnknownFileError(f"{path}: {error}") from error
        # A damaged file fails in any of a dozen ways: zip, zlib, numpy's and Arrow's own
        # errors, JSON, missing keys, memory for absurd sizes, and our validation.
        except Exception as error:
            raise UnknownFileError(
                f"{path} is damaged: truncated, or changed after it was saved "
                f"({type(error).__name__}: {error}). Save it again, or take a backup."
            ) from error
