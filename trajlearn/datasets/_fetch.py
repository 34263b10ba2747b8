"""Downloads of data sets: whole or not at all, checked, and kept for the next call."""

import gzip
import hashlib
import http.client
import os
import secrets
import ssl
import tarfile
import tempfile
import time
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from tqdm import tqdm

__all__ = ["RemoteFile", "fetch", "fetch_archive", "get_data_home"]

_CHUNK_BYTES = 1 << 18
_TIMEOUT_S = 30.0
# A download that takes longer shows a progress bar, if wanted.
_BAR_DELAY_S = 1.0
# No data set of ours is near this size, packed or unpacked: whoever sends more is up to no good.
_MAX_BYTES = 2 << 30
# Answers worth asking again for: a timeout, too many requests, and troubles of the server.
_PASSING_STATUS = {408, 425, 429, 500, 502, 503, 504}
_CONNECTION_ERRORS = (
    URLError,
    TimeoutError,
    ConnectionError,
    ssl.SSLError,
    http.client.HTTPException,
)
# What a damaged or hostile archive raises: not all are errors of tarfile's own.
_BAD_ARCHIVE = (
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    EOFError,
    ValueError,
    OverflowError,
)


@dataclass(frozen=True)
class RemoteFile:
    """A file of a data set.

    Attributes
    ----------
    name : str
        Where it goes, relative to the folder of the data set.
    url : str
    sha256 : str
        Of its content, in lower-case hexadecimal digits.
    """

    name: str
    url: str
    sha256: str


def get_data_home(data_home: str | Path | None = None) -> Path:
    """The folder that downloaded data sets are kept in; it is created if it is not there.

    Parameters
    ----------
    data_home : str or Path, optional
        By default the environment variable ``TRAJLEARN_DATA``, else ``~/trajlearn_data``.

    Returns
    -------
    Path

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     get_data_home(Path(folder) / "data").name
    'data'
    """
    if data_home is None:
        data_home = os.environ.get("TRAJLEARN_DATA") or Path("~", "trajlearn_data")
    folder = Path(data_home).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def fetch(
    files: Sequence[RemoteFile],
    folder: str | Path,
    *,
    download_if_missing: bool = True,
    n_retries: int = 3,
    delay: float = 1.0,
    verbose: int = 0,
) -> Path:
    """Download the files that `folder` lacks.

    A file that is there is checked by its SHA-256 and costs no request; one that was changed is
    downloaded again, with a warning. A file appears under its name only when it is complete
    and its SHA-256 is right.

    Parameters
    ----------
    files : sequence of RemoteFile
    folder : str or Path
        Created if it is not there.
    download_if_missing : bool, default=True
        With False, a missing or changed file is an error.
    n_retries : int, default=3
        How often to ask again after a failure that may pass: no connection, one that breaks or
        stalls, an overloaded server.
    delay : float, default=1.0
        Seconds before the first retry; doubled for each further one.
    verbose : int, default=0
        With 1, a progress bar for each download.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OSError
        If a file cannot be downloaded, or is not the one that was asked for.
    """
    folder = Path(folder)
    for file in files:
        path = folder / file.name
        found = _sha256(path) if path.is_file() else None
        if found == file.sha256:
            continue
        advice = f"Pass path= a copy of the data, or download {file.url} by hand to {path}."
        if not download_if_missing:
            problem = "is missing" if found is None else "was changed"
            raise OSError(f"{path} {problem} and download_if_missing=False. {advice}")
        if found is not None:
            warnings.warn(f"{path} was changed: downloading it again.", stacklevel=3)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
        try:
            _download(file.url, part, file.sha256, advice, n_retries, delay, verbose)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    return folder


def fetch_archive(
    url: str,
    folder: str | Path,
    *,
    sha256: str | None = None,
    download_if_missing: bool = True,
    n_retries: int = 3,
    delay: float = 1.0,
    verbose: int = 0,
) -> Path:
    """Download the ``.tar.gz`` of a source repository and unpack it as `folder`.

    The archive's only top folder becomes `folder`, which appears when everything is unpacked. One
    that is there and not empty is taken as it is, without a request: delete it to download again.
    Links and devices in the archive are left out. A server packs the archives of a commit on
    demand, so that their SHA-256 may be unknown or change; without one, the checksum that gzip
    keeps finds damage on the way, but only the encrypted connection and the commit in the URL
    vouch for the content: check what can be checked in the files themselves.

    Parameters
    ----------
    url : str
    folder : str or Path
    sha256 : str, optional
        Of the archive.
    download_if_missing, n_retries, delay, verbose
        As for `fetch`.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OSError
        If the archive cannot be downloaded, or is damaged, unsafe or of another kind.
    """
    folder = Path(folder)
    if _is_filled(folder):
        return folder
    advice = (
        f"Pass path= a copy of the data, or download {url} by hand and unpack what its top folder "
        f"holds into {folder}."
    )
    if not download_if_missing:
        raise OSError(f"{folder} is missing or empty and download_if_missing=False. {advice}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as scratch:
        archive = Path(scratch, "archive")
        _download(url, archive, sha256, advice, n_retries, delay, verbose)
        try:
            top = _unpack(archive, Path(scratch, "tree"))
        except _BAD_ARCHIVE as error:
            raise OSError(
                f"{url} is not a sound .tar.gz of one folder ({type(error).__name__}: {error}). "
                f"Try again later. {advice}"
            ) from error
        try:
            os.replace(top, folder)
        except OSError:
            # Another process may have been faster.
            if not _is_filled(folder):
                raise
    return folder


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _is_filled(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _download(
    url: str,
    path: Path,
    sha256: str | None,
    advice: str,
    n_retries: int,
    delay: float,
    verbose: int,
) -> None:
    """Write to `path`, as often as it takes; what is there after an error is not to be used."""
    for attempt in range(n_retries + 1):
        try:
            found = _stream(url, path, verbose)
            break
        except _CONNECTION_ERRORS as error:
            final = isinstance(error, HTTPError) and error.code not in _PASSING_STATUS
            if final or attempt == n_retries:
                raise OSError(
                    f"cannot download {url} ({error}; attempt {attempt + 1} of {n_retries + 1}). "
                    f"Check the connection and call again. {advice}"
                ) from error
            time.sleep(delay * 2**attempt)
    if sha256 is not None and found != sha256:
        raise OSError(
            f"{url} has the SHA-256 {found}, expected {sha256}: it was changed there or damaged on "
            f"the way. Call again later. {advice}"
        )


class _StaysEncrypted(HTTPRedirectHandler):
    """Follows no redirect from an encrypted connection to another, which anyone could answer."""

    def redirect_request(
        self,
        req: Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> Request | None:
        if req.type == "https" and urlsplit(newurl).scheme != "https":
            raise HTTPError(
                req.full_url, code, f"it redirects to {newurl}, not encrypted: refused", headers, fp
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _stream(url: str, path: Path, verbose: int) -> str:
    """Write the body of the answer to `path`; return its SHA-256."""
    digest, n_bytes = hashlib.sha256(), 0
    request = Request(url, headers={"User-Agent": "trajlearn"})
    opener = build_opener(_StaysEncrypted)
    with opener.open(request, timeout=_TIMEOUT_S) as response, path.open("wb") as handle:
        announced = response.length
        with tqdm(
            desc=url.rpartition("/")[2],
            total=announced,
            unit="B",
            unit_scale=True,
            delay=_BAR_DELAY_S,
            disable=not verbose,
        ) as bar:
            while piece := response.read(_CHUNK_BYTES):
                n_bytes += len(piece)
                if n_bytes > _MAX_BYTES:
                    raise OSError(f"{url} is longer than {_MAX_BYTES} bytes: not downloaded.")
                digest.update(piece)
                handle.write(piece)
                bar.update(len(piece))
    if announced is not None and n_bytes < announced:
        raise ConnectionError(f"the connection closed after {n_bytes} of {announced} bytes")
    return digest.hexdigest()


class _BoundedGzip(gzip.GzipFile):
    """Unpacks no more than `_MAX_BYTES`, however well they were compressed."""

    def read(self, size: int | None = -1) -> bytes:
        piece = super().read(size)
        if self.tell() > _MAX_BYTES:
            raise tarfile.ReadError(f"it unpacks to more than {_MAX_BYTES} bytes")
        return piece


def _plain(member: tarfile.TarInfo, folder: str) -> tarfile.TarInfo | None:
    """Folders and ordinary files inside `folder`; nothing else is needed, or safe."""
    if not (member.isdir() or member.isfile()) or member.issparse():
        return None
    return tarfile.data_filter(member, folder)


def _unpack(archive: Path, tree: Path) -> Path:
    """Unpack into the new folder `tree`; return the archive's only top folder in it."""
    tree.mkdir()
    with _BoundedGzip(archive) as stream:
        with tarfile.open(fileobj=stream, mode="r|") as tar:
            tar.extractall(tree, filter=_plain)
        # gzip's checksum stands after the end of the archive proper.
        while stream.read(_CHUNK_BYTES):
            pass
    found = list(tree.iterdir())
    if len(found) != 1 or not found[0].is_dir():
        raise tarfile.ReadError(f"it has {len(found)} entries at the top, expected one folder")
    return found[0]
