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


def read_checked(path: Path, sha256: str) -> bytes:
    """The content of a file, uncompressed if its name ends in ``.xz``.

    Parameters
    ----------
    path : Path
    sha256 : str
        Of the uncompressed content.

    Raises
    ------
    UnknownFileError
        If the content is another.
    """
    content = path.read_bytes()
    try:
        content = lzma.decompress(content) if path.suffix == ".xz" else content
    except lzma.LZMAError as error:
        raise UnknownFileError(
            f"{path} is not a sound .xz file ({error}): copy it again."
        ) from None
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise UnknownFileError(
            f"{path} was changed or is another version: its content has the SHA-256 {found}, "
            f"expected {sha256}. Copy it again."
        )
    return content
