"""Fetching ModelNet40 from a server of our own, which misbehaves in every way that servers do."""

import hashlib
import io
import os
import re
import shutil
import sys
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from email.message import Message
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch

from idam.errors import InputError, MissingDependencyError
from idam.lab.data import download
from idam.lab.data.download import fetch_modelnet40
from idam.lab.data.modelnet40 import load

h5py = pytest.importorskip("h5py")

NAME = "modelnet40_ply_hdf5_2048"
PART = f"{NAME}.zip.part"
FILES = ["ply_data_test0.h5", "ply_data_train0.h5", "ply_data_train1.h5", "test_files.txt", "train_files.txt"]


@cache
def h5(shapes: int, seed: int, count: int = 1024) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file["data"] = np.random.default_rng(seed).standard_normal((shapes, count, 3)).astype(np.float32)
        file["label"] = np.arange(shapes, dtype=np.uint8)[:, None]
    return stream.getvalue()


def archive(seed: int = 0, packing: int = zipfile.ZIP_STORED, **changes: bytes | None) -> bytes:
    """A small ModelNet40 of two training files and one test file; the changes are by name, whose dots are __."""
    members = {
        "train_files.txt": f"data/{NAME}/ply_data_train0.h5\ndata/{NAME}/ply_data_train1.h5\n".encode(),
        "test_files.txt": f"data/{NAME}/ply_data_test0.h5\n".encode(),
        "ply_data_train0.h5": h5(2, seed),
        "ply_data_train1.h5": h5(1, seed + 1),
        "ply_data_test0.h5": h5(1, seed + 2),
    } | {name.replace("__", "."): content for name, content in changes.items()}
    return packed({f"{NAME}/{name}": content for name, content in members.items() if content is not None}, packing)


def packed(members: dict[str, bytes], packing: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packing) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return stream.getvalue()


BODY = archive()
HALF = len(BODY) // 2
SHA256 = hashlib.sha256(BODY).hexdigest()  # zipfile alone takes an archive with junk before it


@dataclass
class Site:
    """What the server sends, how it behaves, and what it has been asked."""

    url: str = ""
    body: bytes = BODY
    headers: dict[str, str] = field(default_factory=lambda: {"ETag": '"one"'})
    status: int = 200
    length: bool = True  # whether it says how long the body is
    ranges: bool = True
    if_range: bool = True  # whether it heeds If-Range
    shift: int = 0  # of the range it sends, off the one it is asked for
    breaks_at: int | None = None  # offset in the body
    silent: threading.Event | None = None  # it waits there for this, rather than to hang up
    asked: list[Message] = field(default_factory=list)


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        site: Site = self.server.site  # type: ignore[attr-defined]
        site.asked.append(self.headers)
        start, end = self.start(site), site.breaks_at
        if site.status != 200 or (start and start >= len(site.body)):
            self.send_error(416 if site.status == 200 else site.status)
            return
        self.send_response(206 if start else 200)
        for name, value in site.headers.items():
            self.send_header(name, value)
        if start:
            start += site.shift
            self.send_header("Content-Range", f"bytes {start}-{len(site.body) - 1}/{len(site.body)}")
        if site.length:
            self.send_header("Content-Length", str(len(site.body) - start))
        self.end_headers()
        self.wfile.write(site.body[start:end])
        if site.silent:
            site.silent.wait(10)

    def start(self, site: Site) -> int:
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        same = not site.if_range or self.headers.get("If-Range") in site.headers.values()
        return int(asked[1]) if asked and site.ranges and same else 0

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.setenv(name, "127.0.0.1")
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.site = Site(f"http://127.0.0.1:{server.server_port}/{NAME}.zip")  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server.site  # type: ignore[attr-defined]
        server.shutdown()
        thread.join()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "data" / "modelnet40"


def refused(*arguments: object, **options: object) -> str:
    """The one line with which a call is refused."""
    with pytest.raises(InputError) as caught:
        fetch_modelnet40(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def assert_complete(folder: Path, seed: int = 0) -> None:
    """Asserts that the folder holds the data set of that seed, and nothing else."""
    assert [path.name for path in folder.iterdir()] == [NAME]
    assert sorted(path.name for path in (folder / NAME).iterdir()) == FILES
    assert len(load(folder, "train")) == 3
    with h5py.File(io.BytesIO(h5(1, seed + 2))) as file:
        assert torch.equal(load(folder, "test").points, torch.from_numpy(file["data"][:]))


def break_off(site: Site, folder: Path, at: int = HALF) -> str:
    """Leaves the first so many bytes of an archive in the folder."""
    site.breaks_at = at
    message = refused(folder, site.url)
    site.breaks_at = None
    site.asked.clear()
    return message


def test_the_archive_is_fetched_and_unpacked(site, folder):
    seen = []
    assert fetch_modelnet40(str(folder), site.url, progress=lambda *figures: seen.append(figures)) == folder
    assert_complete(folder)
    assert [headers["Range"] for headers in site.asked] == [None]
    assert seen == sorted(seen)
    assert seen[0] == (0, len(BODY))
    assert seen[-1] == (len(BODY), len(BODY))


def test_a_packed_archive_is_unpacked(site, folder):
    site.body = archive(packing=zipfile.ZIP_DEFLATED)
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)


@pytest.mark.parametrize("held", [".", NAME], ids=["the folder above", "the folder itself"])
def test_what_is_there_is_checked_and_not_fetched(held, site, folder):
    fetch_modelnet40(folder, site.url)
    site.asked.clear()
    assert fetch_modelnet40(folder / held, site.url) == folder / held
    (folder / NAME / "ply_data_test0.h5").write_bytes(b"nonsense")
    message = refused(folder / held, site.url)
    assert str(folder / NAME) in message
    assert "ply_data_test0.h5" in message
    assert "move it away" in message
    assert not site.asked


def test_a_length_the_server_does_not_tell_is_none(site, folder):
    site.length = False
    seen = []
    fetch_modelnet40(folder, site.url, progress=lambda *figures: seen.append(figures))
    assert_complete(folder)
    assert seen[-1] == (len(BODY), None)


def test_a_file_url_is_copied(folder, tmp_path):
    copy = tmp_path / "copy.zip"
    copy.write_bytes(BODY)
    fetch_modelnet40(folder, copy.as_uri())
    assert_complete(folder)
    assert copy.read_bytes() == BODY


# Going on


@pytest.mark.parametrize(
    ("headers", "mark"),
    [
        ({"ETag": '"one"', "Last-Modified": "Mon, 05 Jan 2026 10:00:00 GMT"}, '"one"'),
        ({"Last-Modified": "Mon, 05 Jan 2026 10:00:00 GMT"}, "Mon, 05 Jan 2026 10:00:00 GMT"),
        ({"ETag": 'W/"one"', "Last-Modified": "Mon, 05 Jan 2026 10:00:00 GMT"}, "Mon, 05 Jan 2026 10:00:00 GMT"),
    ],
    ids=["ETag", "date", "weak ETag and date"],
)
def test_a_broken_download_goes_on_where_it_broke(headers, mark, site, folder):
    site.headers = headers
    message = break_off(site, folder)
    assert f"{HALF:,} of {len(BODY):,} bytes" in message
    assert "goes on from there" in message
    assert (folder / PART).read_bytes() == BODY[:HALF]

    seen = []
    fetch_modelnet40(folder, site.url, progress=lambda *figures: seen.append(figures))
    assert_complete(folder)
    assert [(asked["Range"], asked["If-Range"]) for asked in site.asked] == [(f"bytes={HALF}-", mark)]
    assert seen[0] == (HALF, len(BODY))
    assert seen[-1] == (len(BODY), len(BODY))


def test_it_may_break_again_and_again(site, folder):
    for at in (1000, 2000, HALF):
        break_off(site, folder, at)
        assert (folder / PART).read_bytes() == BODY[:at]
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)


def test_a_break_in_an_answer_of_unknown_length_is_noticed(site, folder):
    start = f"{len(BODY):x}\r\n".encode()
    site.headers, site.length = {"ETag": '"one"', "Transfer-Encoding": "chunked"}, False
    site.body = start + BODY + b"\r\n0\r\n\r\n"
    assert f"broke after {HALF:,} bytes (" in break_off(site, folder, len(start) + HALF)
    fetch_modelnet40(folder, site.url, SHA256)
    assert_complete(folder)


def test_a_silent_server_is_given_up(site, folder, monkeypatch):
    monkeypatch.setattr(download, "TIMEOUT", 1.0)  # less, and a busy machine answers too late
    site.silent = threading.Event()
    message = break_off(site, folder)
    site.silent.set()
    assert f"{HALF:,} of {len(BODY):,} bytes (timed out)" in message
    assert (folder / PART).read_bytes() == BODY[:HALF]


def test_ctrl_c_while_it_comes_keeps_what_came(site, folder):
    def interrupt(done: int, total: int | None) -> None:
        if done:
            raise KeyboardInterrupt

    site.breaks_at = HALF  # or the first chunk might be all of it
    with pytest.raises(KeyboardInterrupt):
        fetch_modelnet40(folder, site.url, progress=interrupt)
    site.breaks_at = None
    came = (folder / PART).stat().st_size
    assert came > 0
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)
    assert site.asked[-1]["Range"] == f"bytes={came}-"


@pytest.mark.parametrize("answer", ["whole", "416", "another range", "no mark"])
def test_a_server_that_cannot_go_on_starts_again(answer, site, folder):
    if answer == "no mark":
        site.headers = {}
    message = break_off(site, folder)
    if answer == "whole":
        site.ranges = False
    elif answer == "416":
        site.if_range = False
        with (folder / PART).open("ab") as stream:
            stream.write(bytes(len(BODY)))
    elif answer == "another range":
        site.shift = 10
    else:
        assert "goes on from there" not in message
    fetch_modelnet40(folder, site.url, SHA256)
    assert_complete(folder)
    assert site.asked[-1]["Range"] == (f"bytes={HALF}-" if answer == "whole" else None)


@pytest.mark.parametrize(
    ("headers", "if_range", "packing"),
    [
        ({"ETag": '"two"'}, True, zipfile.ZIP_STORED),
        ({"ETag": '"two"'}, False, zipfile.ZIP_STORED),
        ({}, False, zipfile.ZIP_DEFLATED),
    ],
    ids=["If-Range heeded", "ignored, of the same size", "ignored, unmarked, of another size"],
)
def test_two_versions_are_not_mixed(headers, if_range, packing, site, folder):
    break_off(site, folder)
    site.body, site.headers, site.if_range = archive(7, packing), headers, if_range
    fetch_modelnet40(folder, site.url, hashlib.sha256(site.body).hexdigest())
    assert_complete(folder, seed=7)
    assert site.asked[0]["Range"] == f"bytes={HALF}-"


def test_two_addresses_are_not_mixed(site, folder):
    break_off(site, folder)
    site.body = archive(seed=7)
    fetch_modelnet40(folder, f"{site.url}?other")
    assert_complete(folder, seed=7)
    assert [asked["Range"] for asked in site.asked] == [None]


@pytest.mark.parametrize("note", [None, b"", b"[]", b"{}", b"\xff"])
def test_a_part_of_unknown_origin_is_not_gone_on_with(note, site, folder):
    break_off(site, folder)
    if note is None:
        (folder / f"{PART}.json").unlink()
    else:
        (folder / f"{PART}.json").write_bytes(note)
    fetch_modelnet40(folder, site.url, SHA256)
    assert_complete(folder)
    assert [asked["Range"] for asked in site.asked] == [None]


# What is refused


@pytest.mark.parametrize("status", [403, 404, 416, 503])
def test_a_server_that_refuses_is_quoted(status, site, folder):
    site.status = status
    message = refused(folder, site.url)
    assert message.startswith(f"{site.url}: the server answers {status} ")
    assert "--url" in message


def test_a_refusal_leaves_what_has_come(site, folder):
    break_off(site, folder)
    site.status = 503
    refused(folder, site.url)
    assert (folder / PART).read_bytes() == BODY[:HALF]


def test_an_unreachable_server_is_named(folder, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        url = f"http://127.0.0.1:{server.server_port}/x.zip"
    message = refused(folder, url)
    assert message.startswith(f"{url}: cannot be reached (Connection refused)")


def test_a_missing_file_is_named(folder, tmp_path):
    url = (tmp_path / "none.zip").as_uri()
    assert "No such file" in refused(folder, url)


@pytest.mark.parametrize("url", ["ftp://127.0.0.1/x.zip", "modelnet40.zip", "/tmp/x.zip", "", "http://[", "data:,x"])
def test_other_urls_are_refused_before_anything_is_made(url, folder):
    assert "https://" in refused(folder, url)
    assert not folder.exists()


@pytest.mark.parametrize("url", ["http://", "http://127.0.0.1:port/x", "http://127.0.0.1/x y", "http://127.0.0.1/é"])
def test_malformed_urls_are_refused(url, folder):
    assert "cannot be reached" in refused(folder, url)


def broken_crc() -> bytes:
    body = bytearray(BODY)
    body[HALF] ^= 1
    return bytes(body)


def with_directory(offset: int, value: int) -> bytes:
    """The archive with one 32-bit field of its directory, whose first entry is of train_files.txt, overwritten."""
    at = BODY.index(b"PK\x01\x02") + offset
    return BODY[:at] + value.to_bytes(4, "little") + BODY[at + 4 :]


WRONG = {
    "an HTML page": (b"<!doctype html><title>Moved</title>\n", "a web page"),
    "nothing": (b"", "a web page"),
    "a wrong CRC": (broken_crc(), "damaged zip"),
    "half of a packed archive": (archive(packing=zipfile.ZIP_DEFLATED)[HALF:], "damaged zip"),
    "a name that is not text": (packed({"é": b""}).replace("é".encode(), b"\xc3\xff"), "damaged zip"),
    "a directory that says too much": (with_directory(24, 0xFFFFFFF0), "far more than"),
    "a packing of its own": (archive(packing=zipfile.ZIP_LZMA), "unusual"),
    "another archive": (packed({"readme.txt": b"hello"}), f"({NAME}: no train_files.txt here)"),
    "one without a list": (archive(test_files__txt=None), f"({NAME}: no test_files.txt here)"),
    "one whose list is not text": (archive(test_files__txt=b"\xff\xfe"), "utf-8"),
    "one without a file": (archive(ply_data_train1__h5=None), f"({NAME}/ply_data_train1.h5: "),
    "one with a file that is not HDF5": (archive(ply_data_test0__h5=b"nonsense"), f"({NAME}/ply_data_test0.h5: "),
    "one of too few points": (archive(ply_data_test0__h5=h5(1, 0, count=500)), "(1, 500, 3)"),
}


@pytest.mark.parametrize(("body", "why"), WRONG.values(), ids=WRONG)
def test_what_is_not_the_archive_is_deleted(body, why, site, folder):
    site.body = body
    message = refused(folder, site.url)
    assert message.startswith(site.url)
    assert why in message
    assert "deleted" in message
    assert not list(folder.iterdir())
    site.body = BODY
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)


@pytest.mark.parametrize(
    "name", ["../evil", "/evil", f"{NAME}/../evil", f"{NAME}/../../evil", f"{NAME}/a/evil", "evil"]
)
def test_other_members_stay_packed(name, site, folder, tmp_path):
    with zipfile.ZipFile(stream := io.BytesIO(BODY), "a") as file:
        file.writestr(name, b"evil")
    site.body = stream.getvalue()
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)
    assert not list(tmp_path.rglob("*evil*"))


def test_a_checksum_is_checked(site, folder):
    message = refused(folder, site.url, "0" * 64)
    assert SHA256 in message
    assert "0" * 64 in message
    assert "deleted" in message
    assert not list(folder.iterdir())
    fetch_modelnet40(folder, site.url, SHA256.upper())
    assert_complete(folder)


def test_a_checksum_must_be_one(site, folder):
    assert "64" in refused(folder, site.url, "d41d8cd98f00b204e9800998ecf8427e")
    assert not site.asked


def test_without_h5py_nothing_is_fetched(site, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[train\]'"):
        fetch_modelnet40(folder, site.url)
    assert not site.asked


# The disk


def test_ctrl_c_while_unpacking_leaves_the_archive_alone(site, folder, monkeypatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(download, "load", interrupt)
        fetch_modelnet40(folder, site.url)
    assert sorted(path.name for path in folder.iterdir()) == [PART, f"{PART}.json"]
    assert (folder / PART).read_bytes() == BODY
    site.asked.clear()
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)
    assert not site.asked  # it was complete


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("suffix", [".part", ".h5"], ids=["downloading", "unpacking"])
def test_a_full_disk_is_told(suffix, site, folder, monkeypatch):
    opened = Path.open

    def to_full_disk(path: Path, mode: str = "r", *rest: object) -> object:
        full = path.suffix == suffix and mode in ("ab", "wb")
        return opened(Path("/dev/full") if full else path, mode, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", to_full_disk)
        message = refused(folder, site.url)
    assert message.startswith(f"{folder}: cannot be written (No space left on device): make room")
    assert {path.name for path in folder.iterdir()} <= {PART, f"{PART}.json"}
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)


def test_a_folder_that_cannot_be_made_is_refused(site, tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        assert refused(folder, site.url).startswith(f"{folder}: cannot be written (")
    assert not site.asked


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="nothing is write-protected for root")
def test_a_write_protected_folder_is_refused(site, folder):
    folder.mkdir(parents=True)
    folder.chmod(0o555)
    assert "Permission denied" in refused(folder, site.url)


def test_a_part_that_cannot_be_written_is_refused(site, folder):
    (folder / PART / "content").mkdir(parents=True)
    assert refused(folder, site.url).startswith(f"{folder}: cannot be written (")
    shutil.rmtree(folder / PART)
    fetch_modelnet40(folder, site.url)
    assert_complete(folder)
