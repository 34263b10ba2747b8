"""Files of a data set that the user has already, checked before they are believed."""

import hashlib
import lzma
from pathlib import Path

from trajlearn.exceptions import UnknownFileError

__all__ = ["read_checked", "require_folder"]


def require_folder(path: str | Path) -> Path:
    """The folder `path`.

    Raises
    ------
    ValueError
        If there is none.
    """
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise ValueError(
            f"path={str(path)!r} is not a folder. Name the folder of the data, or leave path out "
            "to download them."
        )
    return folder


# Of the decompressor; what `xz -9` packed needs 65 MiB.
_MAX_MEMORY = 128 << 20


def read_checked(path: Path, sha256: str, max_bytes: int) -> bytes:
    """The content of a file, uncompressed if its name ends in ``.xz``.

    Parameters
    ----------
    path : Path
    sha256 : str
        Of the uncompressed content.
    max_bytes : int
        More than the content has: a file that has more is not read, or unpacked, to its end.

    Raises
    ------
    UnknownFileError
        If the content is another.
    """
    with path.open("rb") as handle:
        content = handle.read(max_bytes + 1)
    if path.suffix == ".xz" and len(content) <= max_bytes:
        unpack = lzma.LZMADecompressor(memlimit=_MAX_MEMORY)
        try:
            content = unpack.decompress(content, max_bytes + 1)
            if not unpack.eof and len(content) <= max_bytes:
                raise lzma.LZMAError("it ends too early")
        except lzma.LZMAError as error:
            raise UnknownFileError(
                f"{path} is not a sound .xz file ({error}): copy it again."
            ) from None
    if len(content) > max_bytes:
        raise UnknownFileError(
            f"{path} is another file: it has more than {max_bytes} bytes, packed or unpacked. "
            "Copy it again."
        )
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise UnknownFileError(
            f"{path} was changed or is another version: its content has the SHA-256 {found}, "
            f"expected {sha256}. Copy it again."
        )
    return content
