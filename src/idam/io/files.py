"""Whole files in and out: reading bytes, and writing them atomically."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import secrets
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError

__all__ = [
    "StrPath",
    "check_destination",
    "check_unpacked_size",
    "make_folder",
    "one_line",
    "read_bytes",
    "silenced",
    "write_bytes",
    "write_json",
    "write_text",
]

StrPath = str | os.PathLike[str]


def read_bytes(path: StrPath) -> bytes:
    """Read a file that is there, regular, readable and not empty.

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
        data = file.read_bytes()
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({one_line(error)}): check its permissions") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: thin it out first") from error
    if not data:
        raise InputError(f"{path}: is empty (0 bytes): copy or export it again")
    return data


def write_bytes(path: StrPath, data: bytes) -> None:
    """Write a file through a temporary one in the same folder, so that it is there whole or not at all.

    Raises:
        InputError: the folder is missing, or the file cannot be written.
    """
    try:
        _replace(check_destination(path), data)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written ({one_line(error)}): write to another folder") from error


def check_destination(path: StrPath) -> Path:
    """Find the file that writing to ``path`` will write.

    Raises:
        InputError: it cannot be written, as far as one can tell without trying.
    """
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


def _replace(target: Path, data: bytes) -> None:
    temporary = target.with_name(f".idam-{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


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
