"""Fetching ModelNet40: a download that goes on where it broke off, and a folder that is there whole or not at all.

Our own code, not pooch: that begins 435 MB anew when the connection breaks, and wants a checksum that nobody publishes.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from email.message import Message
from http import HTTPStatus
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from idam import __version__
from idam.errors import InputError
from idam.io.files import one_line, write_json
from idam.lab.data.modelnet40 import import_h5py, load

__all__ = ["MODELNET40_URL", "fetch_modelnet40"]

Progress = Callable[[int, int | None], None]
"""Called with the bytes that are there and, where the server says it, with how many there will be."""

NAME = "modelnet40_ply_hdf5_2048"
MODELNET40_URL = f"https://shapenet.cs.stanford.edu/media/{NAME}.zip"
"""Where the data set has long been. The server comes and goes, which is why the address is an option."""

TIMEOUT = 30.0
"""Seconds of silence after which the server counts as gone."""

LARGEST = 2**32
"""Bytes that may be unpacked, several times what ModelNet40 has: tighter than ``check_unpacked_size`` on 435 MB."""

_CHUNK = 2**20
_SPLITS = ("train", "test")
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_MEMBER = re.compile(rf"{NAME}/(\w[\w.-]*)")
_OTHERWISE = "try again later, or give another --url (file:///... for a copy on this computer)"


def fetch_modelnet40(
    folder: str | Path, url: str = MODELNET40_URL, sha256: str | None = None, *, progress: Progress | None = None
) -> Path:
    """Download ModelNet40 (about 435 MB) and unpack it; if the folder already holds it, only check it.

    An interrupted download leaves ``modelnet40_ply_hdf5_2048.zip.part`` and a note beside it, and the next call with
    the same URL goes on from there, as long as the server still has the same file.

    Args:
        folder: where ``modelnet40_ply_hdf5_2048`` goes; made if it is missing.
        url: of the zip archive; http, https or file.
        sha256: of the archive, in hexadecimal, to check before unpacking. The archive's own CRCs are always checked.
        progress: called as the download goes, with the bytes so far and the total, or None if that is unknown.

    Returns:
        The folder to give to ``--data``.

    Raises:
        InputError: the archive cannot be had or is not ModelNet40, the folder cannot be written, or what it holds is
            damaged.
        MissingDependencyError: h5py is not installed.
    """
    folder = Path(folder)
    _check_request(url, sha256)
    part = folder / f"{NAME}.zip.part"
    try:
        if not _check_held(folder):
            folder.mkdir(parents=True, exist_ok=True)
            _download(url, part, progress or (lambda done, total: None))
            _install(part, folder, url, sha256)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        mend = "make room, then run the same command again" if full else "check it or choose another folder"
        raise InputError(f"{folder}: cannot be written ({one_line(error)}): {mend}") from error
    return folder


def _check_request(url: str, sha256: str | None) -> None:
    """Refuse at once what would fail later, perhaps after the download.

    Raises:
        InputError: the URL or the checksum is malformed.
        MissingDependencyError: h5py is not installed.
    """
    import_h5py()
    try:
        known = urlsplit(url).scheme in ("http", "https", "file")
    except ValueError:
        known = False
    if not known:
        raise InputError(f"{url}: not a URL to download from: give one that begins with https://, http:// or file://")
    if sha256 is not None and not re.fullmatch("[0-9a-fA-F]{64}", sha256):
        raise InputError(f"{sha256}: not a SHA-256: give its 64 hexadecimal digits")


def _check_held(folder: Path) -> bool:
    """Whether the folder holds the data set already.

    Raises:
        InputError: it holds something of it, which cannot be read.
    """
    held = folder / NAME
    if not held.exists():
        held = folder
        if not any((folder / f"{split}_files.txt").exists() for split in _SPLITS):
            return False
    try:
        _check_data(held)
    except InputError as error:
        raise InputError(f"{held}: {error}: move it away and run this again") from error
    return True


def _check_data(folder: Path) -> None:
    """Read all of both splits.

    Raises:
        InputError: that fails; the message is to follow a name, and its paths begin at the folder.
    """
    for split in _SPLITS:
        try:
            load(folder, split)
        except ValueError as error:  # InputError, or a list that is not text
            reason = " ".join(str(error).split()).rsplit(";", 1)[0]  # its advice is for who unpacked by hand
            reason = reason.replace(f"{folder.parent}{os.sep}", "")
            raise InputError(f"is not a whole ModelNet40 ({reason})") from error


# The download


@dataclass(frozen=True)
class _Version:
    """What tells the file at a URL from all others, so that two are never mixed: its ETag or date, and its size."""

    url: str
    validator: str
    size: int


def _download(url: str, part: Path, progress: Progress) -> None:
    """Bring the partial file to its full length, from where it ends if the server still has the same file.

    Raises:
        InputError: the server cannot be reached, refuses or breaks off.
    """
    version = _noted_version(url, part)
    done = part.stat().st_size if version else 0
    if version and done == version.size:  # interrupted while it was unpacked
        return
    with _open_from(url, version, done) as response:
        if version is None or response.status != HTTPStatus.PARTIAL_CONTENT:
            _discard(part)
            done, version = 0, _version_of(url, response.headers)
            if version:  # before the first byte, which must not be taken for one of another version
                write_json(_note(part), asdict(version))
        _receive(response, url, part, version, progress, done)


def _receive(response: Any, url: str, part: Path, version: _Version | None, progress: Progress, done: int) -> None:
    """Append what comes to the partial file.

    Raises:
        InputError: it ends too early.
    """
    total = version.size if version else _length(response.headers)
    broken: Exception | None = None
    with part.open("ab") as stream:
        progress(done, total)
        while True:
            try:
                chunk = response.read1(_CHUNK)  # not read, which on a failure loses what had come
            except (OSError, HTTPException) as error:
                broken = error
                break
            if not chunk:
                break
            stream.write(chunk)
            done += len(chunk)
            progress(done, total)
    if broken or (total is not None and done < total):
        came = f"{done:,} of {total:,} bytes" if total is not None else f"{done:,} bytes"
        why = f" ({one_line(broken)})" if broken else ""
        how = "it goes on from there" if version else "from the start, since this server marks no versions"
        raise InputError(f"{url}: the connection broke after {came}{why}: run the same command again, {how}")


def _open_from(url: str, version: _Version | None, done: int) -> Any:
    """Ask for the rest of a version; what answers begins either right there or, if it has to, at the start."""
    if version is None or done == 0:
        return _open(url, {})
    response = _open(url, {"Range": f"bytes={done}-", "If-Range": version.validator})
    if response is None:
        return _open(url, {})
    if response.status == HTTPStatus.PARTIAL_CONTENT:
        span = re.fullmatch(rf"bytes {done}-\d+/(\d+)", response.headers.get("Content-Range", ""))
        same = _validator(response.headers) in (None, version.validator)
        if not (span and int(span[1]) == version.size and same):  # some servers ignore If-Range
            response.close()
            return _open(url, {})
    return response


def _open(url: str, headers: dict[str, str]) -> Any:
    """Send a request; None if the server does not have the range that the headers ask for.

    Raises:
        InputError: there is no server, or it refuses.
    """
    try:
        return urlopen(Request(url, headers={"User-Agent": f"idam/{__version__}", **headers}), timeout=TIMEOUT)
    except HTTPError as error:
        error.close()
        if headers and error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            return None
        raise InputError(f"{url}: the server answers {error.code} {error.reason}: {_OTHERWISE}") from error
    except (OSError, HTTPException, ValueError) as error:
        cause = getattr(error, "reason", error)  # urllib wraps the system's error in its own
        why = one_line(cause if isinstance(cause, Exception) else error)
        raise InputError(f"{url}: cannot be reached ({why}): {_OTHERWISE}") from error


def _version_of(url: str, headers: Message) -> _Version | None:
    validator, size = _validator(headers), _length(headers)
    return None if validator is None or size is None else _Version(url, validator, size)


def _validator(headers: Message) -> str | None:
    """What If-Range takes: an ETag unless it is weak, which says 'much the same' only, or else the date."""
    etag = headers.get("ETag")
    return etag if etag and not etag.startswith("W/") else headers.get("Last-Modified")


def _length(headers: Message) -> int | None:
    length = headers.get("Content-Length", "")
    return int(length) if length.isdecimal() else None


def _noted_version(url: str, part: Path) -> _Version | None:
    """The version that the partial file is of; None if there is no such file, or one of another URL."""
    try:
        version = _Version(**json.loads(_note(part).read_text()))
    except (OSError, TypeError, ValueError):
        return None
    return version if version.url == url and part.is_file() else None


def _note(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _discard(part: Path) -> None:
    part.unlink(missing_ok=True)
    _note(part).unlink(missing_ok=True)


# The archive


def _install(archive: Path, folder: Path, url: str, sha256: str | None) -> None:
    """Check the archive, unpack it beside its place, move the whole there, and delete the archive.

    Raises:
        InputError: it is not the archive of ModelNet40, and has been deleted.
    """
    try:
        _check_sum(archive, sha256)
        with tempfile.TemporaryDirectory(prefix=f".{NAME}-", dir=folder) as temporary:
            unpacked = Path(temporary) / NAME
            unpacked.mkdir()
            _unpack(archive, unpacked)
            _check_data(unpacked)
            unpacked.rename(folder / NAME)
    except InputError as error:
        _discard(archive)
        raise InputError(f"{url}: {error}; what came is deleted: {_OTHERWISE}") from error
    _discard(archive)


def _check_sum(archive: Path, sha256: str | None) -> None:
    if sha256 is None:
        return
    digest = hashlib.sha256()
    with archive.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    if digest.hexdigest() != sha256.lower():
        raise InputError(f"has the SHA-256 {digest.hexdigest()}, expected {sha256.lower()}")


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack the data set's own files, and no others: nothing comes to lie outside the folder, whatever its name.

    Raises:
        InputError: the archive is damaged or not one.
    """
    if not zipfile.is_zipfile(archive):
        raise InputError("is not a zip archive but, say, a web page, or only the beginning of one")
    try:
        with zipfile.ZipFile(archive) as packed:
            members = {found[1]: info for info in packed.infolist() if (found := _MEMBER.fullmatch(info.filename))}
            _check_members(members.values())
            for name, info in members.items():
                with packed.open(info) as source, (folder / name).open("wb") as target:
                    shutil.copyfileobj(source, target, _CHUNK)  # checks the CRC at the end
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, ArithmeticError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # that is an absurd offset in the archive
            raise
        raise InputError(f"is a damaged zip archive ({one_line(error)})") from error


def _check_members(members: Collection[zipfile.ZipInfo]) -> None:
    """Refuse what ModelNet40 cannot be before any of it is unpacked; zipfile itself unpacks no more than promised.

    Raises:
        InputError: a packing of its own, or too much.
    """
    size = sum(info.file_size for info in members)
    if size > LARGEST:
        raise InputError(f"is damaged: promises {size:,} bytes, far more than ModelNet40 has")
    for info in members:
        if info.compress_type not in _PACKINGS:
            raise InputError(f"is packed in an unusual way ({info.filename}: method {info.compress_type})")
