"""Whole files in and out: reading bytes, and writing them atomically."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import secrets
import shutil
import sys
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError

__all__ = [
    "STANDARD",
    "StrPath",
    "check_destination",
    "check_outputs",
    "check_source",
    "check_unpacked_size",
    "make_folder",
    "one_line",
    "read_bytes",
    "replacing",
    "silenced",
    "write_bytes",
    "write_json",
    "write_text",
]

StrPath = str | os.PathLike[str]
STANDARD = "-"
"""The name that means the standard input or output."""


def read_bytes(path: StrPath) -> bytes:
    """Read a file that is there, regular, readable and not empty; ``-`` is the standard input.

    Raises:
        InputError: it is not.
    """
    if os.fspath(path) == STANDARD:
        return _read_standard_input()
    file = check_source(path)
    try:
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: thin it out first") from error
    if not data:
        raise _empty(path)
    return data


def check_source(path: StrPath) -> Path:
    """Find out whether a file is there, regular and not empty.

    Raises:
        InputError: it is not.
    """
    file = Path(path)
    try:
        if file.is_dir():
            raise InputError(f"{path}: is a folder: name a file in it")
        if not file.exists():
            raise InputError(f"{path}: no such file: check the path")
        if not file.is_file():  # a pipe would never end
            raise InputError(f"{path}: not a regular file: copy what it gives into one first")
        if not file.stat().st_size:
            raise _empty(path)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error
    return file


def _read_standard_input() -> bytes:
    if sys.stdin is None or sys.stdin.isatty():
        raise InputError("-: nothing is piped to the standard input: name a file")
    data = sys.stdin.buffer.read()
    if not data:
        raise InputError("-: the standard input is empty, or has been read already: name a file")
    return data


def _unreadable(path: StrPath, error: Exception) -> InputError:
    return InputError(f"{path}: cannot be read ({one_line(error)}): check its permissions")


def _empty(path: StrPath) -> InputError:
    return InputError(f"{path}: is empty (0 bytes): copy or export it again")


def write_bytes(path: StrPath, data: bytes) -> None:
    """Write a file through a temporary one in the same folder, so that it is there whole or not at all.

    ``-`` is the standard output.

    Raises:
        InputError: the folder is missing, or the file cannot be written.
    """
    if os.fspath(path) == STANDARD:
        sys.stdout.flush()
        sys.stdout.buffer.write(data)
        return
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def replacing(path: StrPath) -> Iterator[Path]:
    """A new file beside ``path``, to be written, that takes its place at the end; on an error, all is as it was.

    Raises:
        InputError: the folder is missing, or the file cannot be written.
    """
    target = check_destination(path)
    temporary = target.with_name(f".idam-{secrets.token_hex(8)}.tmp")
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written ({one_line(error)}): write to another folder") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def check_outputs(outputs: Iterable[StrPath | None], inputs: Iterable[StrPath] = ()) -> None:
    """Find out before the work whether all outputs can be written, each to a file of its own that is no input.

    Raises:
        InputError: one cannot, or it would overwrite an input or another output.
    """
    taken = {_identity(path): path for path in inputs if os.fspath(path) != STANDARD}
    read = set(taken)
    for path in outputs:
        if path is None:
            continue
        check_destination(path)
        key = _identity(path)
        if key in read:
            raise InputError(f"{path}: would overwrite an input: write to another file")
        if key in taken:
            raise InputError(f"{path}: two outputs to one file: give each its own")
        taken[key] = path


def _identity(path: StrPath) -> object:
    """What two names of one file share."""
    if os.fspath(path) == STANDARD:
        return STANDARD
    name = os.path.realpath(path)
    try:
        stat = os.stat(name)  # noqa: PTH116
    except (OSError, ValueError):
        return name
    return stat.st_dev, stat.st_ino


def check_destination(path: StrPath) -> Path:
    """Find the file that writing to ``path`` will write.

    Raises:
        InputError: it cannot be written, as far as one can tell without trying.
    """
    if os.fspath(path) == STANDARD:
        return Path(path)
    try:
        target = Path(os.path.realpath(path))  # through a symbolic link, not over it
        if not target.parent.is_dir():
            raise InputError(f"{path}: there is no folder {Path(path).parent}: create it first")
        if target.is_dir():
            raise InputError(f"{path}: is a folder: name a file in it")
        if target.exists() and not (target.is_file() and os.access(target, os.W_OK)):
            raise InputError(f"{path}: is write-protected or not a regular file: write to another file")
        if not os.access(target.parent, os.W_OK):
            raise InputError(f"{path}: its folder is write-protected: write to another folder")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be written ({one_line(error)}): write to another folder") from error
    return target


def make_folder(path: StrPath) -> Path:
    """Make a folder to write to, with those above it, unless it is there.

    Raises:
        InputError: it cannot be made, or not be written.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot make this folder ({one_line(error)}): choose another") from None
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: this folder is write-protected: choose another")
    return folder


def write_text(path: StrPath, text: str) -> None:
    """Write a UTF-8 text file, atomically.

    Raises:
        InputError: it cannot be written.
    """
    write_bytes(path, text.encode())


def write_json(path: StrPath, obj: Any) -> None:
    """Write ``obj`` as JSON, atomically: arrays become lists, and NaN and infinities, which JSON lacks, null.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, json.dumps(_plain(obj), indent=2, allow_nan=False) + "\n")


def _plain(obj: Any) -> Any:
    if isinstance(obj, np.ndarray | np.generic):
        obj = obj.tolist()
    if isinstance(obj, dict):
        return {key: _plain(value) for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [_plain(value) for value in obj]
    return None if isinstance(obj, float) and not math.isfinite(obj) else obj


def one_line(error: BaseException) -> str:
    """Put what an exception says on one line of bearable length; its type if it says nothing."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())[:160] or type(error).__name__


@contextlib.contextmanager
def silenced(logger: str) -> Iterator[None]:
    """Keep a library's warnings and log from the user, who gets the error that follows them."""
    log = logging.getLogger(logger)
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def check_unpacked_size(unpacked: int, packed: int) -> None:
    """Refuse data that would unpack to far more than any real cloud does, before anything is allocated.

    Raises:
        InputError: more than 256 MB and a hundred times the packed bytes.
    """
    if unpacked > 2**28 + 100 * packed:
        raise InputError(f"damaged: its {packed:,} packed bytes promise {unpacked:,}: copy or export it again")
