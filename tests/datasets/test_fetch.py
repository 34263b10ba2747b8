"""Downloads: whole or not at all, checked, kept; against a server of our own on localhost."""

import gzip
import hashlib
import http.server
import io
import os
import socket
import ssl
import struct
import tarfile
import threading
import tracemalloc
import zlib
from email.message import Message
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.request import Request

import numpy as np
import pytest

from trajlearn.datasets import _fetch
from trajlearn.datasets._fetch import RemoteFile, fetch, fetch_archive, get_data_home

BODY = np.random.default_rng(0).bytes(700_000)


def sha256(content):
    return hashlib.sha256(content).hexdigest()


# -- a server that answers each path by a list of acts, the last of them again and again -------


def send(body, *, status=200, announced=None, chunked=False, finish=True):
    def act(handler):
        handler.send_response(status)
        if chunked:
            handler.send_header("Transfer-Encoding", "chunked")
        else:
            handler.send_header("Content-Length", str(announced or len(body)))
        handler.end_headers()
        if chunked:
            handler.wfile.write(b"%x\r\n%s\r\n" % (len(body), body))
            if finish:
                handler.wfile.write(b"0\r\n\r\n")
        else:
            handler.wfile.write(body)

    return act


def reset(body, *, announced):
    """Send a part, then drop the connection hard."""

    def act(handler):
        send(body, announced=announced)(handler)
        handler.wfile.flush()
        hard = struct.pack("ii", 1, 0)
        handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, hard)
        handler.connection.close()

    return act


def hang_up(handler):
    """Close without an answer."""


def redirect(target):
    def act(handler):
        handler.send_response(302)
        handler.send_header("Location", target)
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    return act


class Server(http.server.ThreadingHTTPServer):
    def __init__(self):
        self.acts, self.asked, self.over = {}, [], threading.Event()
        super().__init__(("127.0.0.1", 0), Handler)

    def url(self, path, *acts):
        self.acts[f"/{path}"] = list(acts)
        return f"http://127.0.0.1:{self.server_port}/{path}"

    def handle_error(self, request, client_address):
        """Quiet: clients that leave early are what some tests are about."""


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.asked.append(self.path)
        acts = self.server.acts[self.path]
        (acts.pop(0) if len(acts) > 1 else acts[0])(self)

    def log_message(self, *args):
        """Quiet."""


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    server = Server()
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.over.set()
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(autouse=True)
def waits(monkeypatch):
    """The pauses between attempts, instead of pausing."""
    waits = []
    monkeypatch.setattr(_fetch, "time", SimpleNamespace(sleep=waits.append))
    return waits


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "home" / "flights"


def remote(url, body=BODY, name="a.csv"):
    return RemoteFile(name, url, sha256(body))


def everything(folder):
    """All files at or beside the folder, hidden ones too."""
    return sorted(str(p.relative_to(folder.parent)) for p in folder.parent.rglob("*"))


# -- files -------------------------------------------------------------------------------------


def test_files_arrive_and_a_second_call_asks_for_nothing(server, folder):
    files = [
        remote(server.url("1", send(BODY))),
        remote(server.url("2", send(b"two")), b"two", "pid/b.csv"),
        remote(server.url("3", send(BODY, chunked=True)), name="c.csv"),
        remote(server.url("4", redirect(server.url("5", send(b"")))), b"", "empty"),
    ]
    assert fetch(files, str(folder)) == folder
    assert (folder / "a.csv").read_bytes() == (folder / "c.csv").read_bytes() == BODY
    assert (folder / "pid" / "b.csv").read_bytes() == b"two"
    assert (folder / "empty").read_bytes() == b""
    assert len(everything(folder)) == 6
    assert server.asked == ["/1", "/2", "/3", "/4", "/5"]
    fetch(files, folder)
    fetch(files, folder, download_if_missing=False)
    assert len(server.asked) == 5


@pytest.mark.parametrize(
    ("source", "target", "followed"),
    [
        ("https://a.org/1", "https://b.org/2", True),
        ("https://a.org/1", "http://a.org/1", False),
        ("https://a.org/1", "ftp://a.org/1", False),
        ("http://a.org/1", "http://b.org/2", True),
        ("http://a.org/1", "https://b.org/2", True),
    ],
)
def test_no_redirect_leaves_an_encrypted_connection(source, target, followed):
    handler, request = _fetch._StaysEncrypted(), Request(source)
    handler.parent = SimpleNamespace(open=lambda asked, timeout=None: asked.full_url)
    request.timeout, headers = 1.0, Message()
    headers["Location"] = target
    if followed:
        assert handler.http_error_302(request, io.BytesIO(), 302, "Found", headers) == target
    else:
        with pytest.raises(HTTPError, match=f"redirects to {target}, not encrypted: refused"):
            handler.http_error_302(request, io.BytesIO(), 302, "Found", headers)


def test_downloads_ask_the_handler_of_redirects(server, folder, monkeypatch):
    def refuse(handler, request, *rest):
        raise HTTPError(request.full_url, 302, "refused", None, None)

    monkeypatch.setattr(_fetch._StaysEncrypted, "redirect_request", refuse)
    url = server.url("1", redirect(server.url("2", send(BODY))))
    with pytest.raises(OSError, match=r"refused; attempt 1 of 4"):
        fetch([remote(url)], folder)
    assert server.asked == ["/1"]
    assert everything(folder) == ["flights"]


def test_the_file_has_the_permissions_of_any_new_file(server, folder, tmp_path):
    fetch([remote(server.url("1", send(BODY)))], folder)
    (tmp_path / "other").write_bytes(b"")
    assert (folder / "a.csv").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_changed_file_is_replaced_with_a_warning(server, folder):
    file = remote(server.url("1", send(BODY)))
    fetch([file], folder)
    (folder / "a.csv").write_bytes(BODY[:-1] + b"?")
    with pytest.raises(OSError, match=r"a\.csv was changed and download_if_missing=False"):
        fetch([file], folder, download_if_missing=False)
    with pytest.warns(UserWarning, match=r"a\.csv was changed: downloading it again"):
        fetch([file], folder)
    assert (folder / "a.csv").read_bytes() == BODY


def test_a_missing_file_that_may_not_be_downloaded(server, folder):
    url = server.url("1", send(BODY))
    with pytest.raises(OSError, match=r"a\.csv is missing.*path=.*by hand") as error:
        fetch([remote(url)], folder, download_if_missing=False)
    assert url in str(error.value)
    assert server.asked == []
    assert not folder.exists()


def stall(server):
    def act(handler):
        send(BODY[:1000], announced=len(BODY))(handler)
        server.over.wait()

    return act


BREAKS = {
    "status 500": lambda server: send(b"sorry", status=500),
    "status 429": lambda server: send(b"sorry", status=429),
    "no answer": lambda server: hang_up,
    "closed early": lambda server: send(BODY[:400_000], announced=len(BODY)),
    "closed early, chunked": lambda server: send(BODY[:400_000], chunked=True, finish=False),
    "dropped": lambda server: reset(BODY[:400_000], announced=len(BODY)),
    "stalled": stall,
}


@pytest.mark.parametrize("kind", BREAKS)
def test_what_may_pass_is_tried_again_with_growing_pauses(server, folder, kind, waits, monkeypatch):
    monkeypatch.setattr(_fetch, "_TIMEOUT_S", 0.1 if kind == "stalled" else 5.0)
    bad = BREAKS[kind](server)
    file = remote(server.url("1", bad, bad, send(BODY)))
    fetch([file], folder, delay=0.5)
    assert (folder / "a.csv").read_bytes() == BODY
    assert waits == [0.5, 1.0]


@pytest.mark.parametrize("kind", BREAKS)
def test_what_does_not_pass_leaves_nothing(server, folder, kind, waits, monkeypatch):
    monkeypatch.setattr(_fetch, "_TIMEOUT_S", 0.1 if kind == "stalled" else 5.0)
    url = server.url("1", BREAKS[kind](server))
    with pytest.raises(OSError, match=r"attempt 2 of 2.*path=.*by hand") as error:
        fetch([remote(url)], folder, n_retries=1)
    assert url in str(error.value)
    assert str(folder) in str(error.value)
    assert server.asked == ["/1", "/1"]
    assert everything(folder) == ["flights"]


def test_a_broken_encryption_is_tried_again(server, folder, waits, monkeypatch):
    file = remote(server.url("1", send(BODY)))
    with monkeypatch.context() as patch:

        def broken(response, size):
            patch.undo()
            raise ssl.SSLError("decryption failed or bad record mac")

        patch.setattr(_fetch.http.client.HTTPResponse, "read", broken)
        fetch([file], folder, delay=2)
    assert (folder / "a.csv").read_bytes() == BODY
    assert waits == [2]


def test_a_lasting_refusal_is_not_tried_again(server, folder, waits):
    url = server.url("1", send(b"gone", status=404))
    with pytest.raises(OSError, match=r"404.*attempt 1 of 4"):
        fetch([remote(url)], folder)
    assert server.asked == ["/1"]
    assert waits == []


def test_offline(folder, waits, monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}/1"
        with pytest.raises(OSError, match=r"refused.*Check the connection.*by hand"):
            fetch([remote(url)], folder)
    assert waits == [1, 2, 4]
    assert everything(folder) == ["flights"]


def test_a_file_with_another_content_is_not_kept(server, folder):
    url = server.url("1", send(b"<html>login</html>"))
    with pytest.raises(OSError) as error:
        fetch([remote(url)], folder)
    assert sha256(b"<html>login</html>") in str(error.value)
    assert sha256(BODY) in str(error.value)
    assert server.asked == ["/1"]
    assert everything(folder) == ["flights"]


def test_a_failed_replacement_keeps_what_was_there(server, folder):
    folder.mkdir(parents=True)
    (folder / "a.csv").write_bytes(b"mine")
    with pytest.warns(UserWarning, match="changed"), pytest.raises(OSError, match="404"):
        fetch([remote(server.url("1", send(b"", status=404)))], folder)
    assert (folder / "a.csv").read_bytes() == b"mine"
    assert len(everything(folder)) == 2


def test_an_interrupt_leaves_nothing(server, folder, monkeypatch):
    def interrupt(bar, n):
        raise KeyboardInterrupt

    monkeypatch.setattr(_fetch.tqdm, "update", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fetch([remote(server.url("1", send(BODY)))], folder)
    with pytest.raises(KeyboardInterrupt):
        fetch_archive(server.url("2", send(packed())), folder / "archive")
    assert everything(folder) == ["flights"]


def test_a_download_without_end_is_stopped(server, folder, monkeypatch):
    monkeypatch.setattr(_fetch, "_MAX_BYTES", 300_000)
    with pytest.raises(OSError, match="longer than 300000 bytes"):
        fetch([remote(server.url("1", send(BODY)))], folder)
    assert server.asked == ["/1"]
    assert everything(folder) == ["flights"]


def test_a_long_download_takes_little_memory(server, folder):
    body = bytes(20_000_000)
    url = server.url("1", send(body))
    tracemalloc.start()
    fetch([remote(url, body)], folder)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000


@pytest.mark.parametrize("verbose", [0, 1])
def test_a_progress_bar_on_demand_for_what_takes_long(server, folder, verbose, capsys, monkeypatch):
    file = remote(server.url("flight7.csv", send(BODY)))
    fetch([file], folder, verbose=verbose)
    assert capsys.readouterr().err == ""
    (folder / "a.csv").unlink()
    monkeypatch.setattr(_fetch, "_BAR_DELAY_S", 0.0)
    fetch([file], folder, verbose=verbose)
    assert ("flight7.csv: 100%" in capsys.readouterr().err) == bool(verbose)


# -- archives ----------------------------------------------------------------------------------


def member(name, content=b"", kind=tarfile.REGTYPE, **fields):
    info = tarfile.TarInfo(name)
    info.size, info.type = len(content), kind
    for field, value in fields.items():
        setattr(info, field, value)
    return info, content


GOOD = [
    member("repo-1a2b", kind=tarfile.DIRTYPE, mode=0o755),
    member("repo-1a2b/logs/log01", BODY),
    member("repo-1a2b/info/1.yaml", b"gain: 1\n", mode=0o777),
]


def packed(members=GOOD):
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w", pax_headers={"comment": "1a2b"}) as tar:
        for info, content in members:
            tar.addfile(info, io.BytesIO(content))
    # no time of day: the same bytes whenever it is packed
    return gzip.compress(raw.getvalue(), mtime=0)


def test_an_archive_is_unpacked_once(server, folder):
    body = packed()
    url = server.url("1", send(body, chunked=True))
    assert fetch_archive(url, str(folder), sha256=sha256(body)) == folder
    assert (folder / "logs" / "log01").read_bytes() == BODY
    assert (folder / "info" / "1.yaml").read_text() == "gain: 1\n"
    assert everything(folder) == [
        "flights",
        *(f"flights/{name}" for name in ("info", "info/1.yaml", "logs", "logs/log01")),
    ]
    fetch_archive(url, folder, download_if_missing=False)
    fetch_archive(url, folder)
    assert server.asked == ["/1"]


def test_an_empty_folder_is_filled(server, folder):
    folder.mkdir(parents=True)
    fetch_archive(server.url("1", send(packed())), folder)
    assert (folder / "logs" / "log01").exists()


def test_a_missing_archive_that_may_not_be_downloaded(server, folder):
    url = server.url("1", send(packed()))
    with pytest.raises(OSError, match=r"flights is missing.*path=.*by hand") as error:
        fetch_archive(url, folder, download_if_missing=False)
    assert url in str(error.value)
    assert server.asked == []
    assert not folder.parent.exists()


def test_a_broken_archive_is_tried_again(server, folder, waits):
    body = packed()
    short = send(body[:-9], announced=len(body))
    fetch_archive(server.url("1", short, send(body)), folder, delay=3)
    assert (folder / "logs" / "log01").read_bytes() == BODY
    assert waits == [3]


def test_an_archive_with_another_sha256(server, folder):
    with pytest.raises(OSError, match=sha256(packed())):
        fetch_archive(server.url("1", send(packed())), folder, sha256="0" * 64)
    assert everything(folder) == []


def flipped(body, index):
    damaged = bytearray(body)
    damaged[index] ^= 4
    return bytes(damaged)


def garbled():
    """Sound up to the midst of a file; then comes a block of a type that deflate does not have."""
    packer = zlib.compressobj(wbits=31)
    start = packer.compress(gzip.decompress(packed())[:50_000])
    return start + packer.flush(zlib.Z_FULL_FLUSH) + b"\7" * 50


def member_with(**headers):
    """A member that pax headers give other values than its own header can hold."""
    return member("repo-1a2b/odd", b"x", pax_headers=headers)


BAD_ARCHIVES = {
    "a page": b"<html>login</html>",
    "nothing": b"",
    "a gzip file": gzip.compress(b"no tar" * 500),
    "no end": packed()[:-9],
    "half": packed()[: len(packed()) // 2],
    "damaged": flipped(packed(), len(packed()) // 2),
    "wrong checksum": flipped(packed(), -8),
    "tar without its end": gzip.compress(gzip.decompress(packed())[:5000]),
    "not deflated": flipped(packed(), 10),
    "garbled": garbled(),
    "zero byte in a name": packed([*GOOD, member_with(path="repo-1a2b/a\0b")]),
    "time after the end of time": packed([*GOOD, member_with(mtime="1e30")]),
    "no member": packed([]),
    "two folders": packed([*GOOD, member("second/file", b"x")]),
    "no folder": packed([member("file", b"x")]),
    "outside": packed([*GOOD, member("repo-1a2b/../../../evil", b"x")]),
    "far outside": packed([*GOOD, member("../evil", b"x")]),
    "absolute": packed([*GOOD, member("/evil", b"x")]),
    "bomb": packed([member("repo-1a2b/zeros", bytes(3_000_000))]),
    "long name": packed([member("repo-1a2b/" + "n" * 3_000_000)]),
}


@pytest.mark.parametrize("kind", BAD_ARCHIVES)
def test_a_bad_archive_is_refused_and_leaves_nothing(server, folder, kind, monkeypatch):
    monkeypatch.setattr(_fetch, "_MAX_BYTES", 2_000_000)
    url = server.url("1", send(BAD_ARCHIVES[kind]))
    with pytest.raises(OSError, match=r"not a sound \.tar\.gz.*path=.*by hand") as error:
        fetch_archive(url, folder)
    assert url in str(error.value)
    assert everything(folder) == []
    assert not (folder.parent.parent / "evil").exists()


def test_links_and_devices_are_left_out(server, folder, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    members = [
        *GOOD,
        member("repo-1a2b/way", kind=tarfile.SYMTYPE, linkname=str(outside)),
        member("repo-1a2b/way/evil", b"x"),
        member("repo-1a2b/up", kind=tarfile.SYMTYPE, linkname="../.."),
        member("repo-1a2b/hard", kind=tarfile.LNKTYPE, linkname="repo-1a2b/logs/log01"),
        member("repo-1a2b/pipe", kind=tarfile.FIFOTYPE),
        member("repo-1a2b/null", kind=tarfile.CHRTYPE, devmajor=1, devminor=3),
    ]
    fetch_archive(server.url("1", send(packed(members))), folder)
    assert sorted(os.listdir(folder)) == ["info", "logs", "way"]
    assert (folder / "way" / "evil").read_bytes() == b"x"
    assert not (folder / "way").is_symlink()
    assert list(outside.iterdir()) == []


def sparse(name, size):
    """A member of GNU's sparse kind: `size` bytes that take no place in the archive."""
    header = bytearray(tarfile.TarInfo(name).tobuf(tarfile.GNU_FORMAT))
    header[156:157] = tarfile.GNUTYPE_SPARSE
    header[386:410] = b"%011o\0%011o\0" % (size, 0)  # the only piece of data: none, at the end
    header[483:495] = b"%011o\0" % size
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return bytes(header)


def test_a_file_of_holes_is_left_out(server, folder):
    tar = sparse("repo-1a2b/holes", 2**30) + gzip.decompress(packed())
    with tarfile.open(fileobj=io.BytesIO(tar)) as archive:
        assert archive.next().size == 2**30
    fetch_archive(server.url("1", send(gzip.compress(tar))), folder)
    assert sorted(os.listdir(folder)) == ["info", "logs"]


def test_modes_from_outside_give_no_one_else_a_pen(server, folder):
    fetch_archive(server.url("1", send(packed())), folder)
    assert (folder / "info" / "1.yaml").stat().st_mode & 0o022 == 0


def test_two_processes_at_once_both_succeed(server, folder, monkeypatch):
    def slower(archive, tree):
        folder.mkdir()
        (folder / "log").write_bytes(b"of the faster one")
        return unpack(archive, tree)

    unpack = _fetch._unpack
    monkeypatch.setattr(_fetch, "_unpack", slower)
    fetch_archive(server.url("1", send(packed())), folder)
    assert everything(folder) == ["flights", "flights/log"]


# -- the folder of all data sets ---------------------------------------------------------------


def test_data_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("TRAJLEARN_DATA", raising=False)
    assert get_data_home() == tmp_path / "trajlearn_data"
    monkeypatch.setenv("TRAJLEARN_DATA", "~/elsewhere")
    assert get_data_home() == tmp_path / "elsewhere"
    assert get_data_home("~/given/deep") == tmp_path / "given" / "deep"
    assert (tmp_path / "given" / "deep").is_dir()
    monkeypatch.setenv("TRAJLEARN_DATA", "")
    assert get_data_home() == tmp_path / "trajlearn_data"
