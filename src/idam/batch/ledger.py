"""What a batch has done, in a folder: every row whole, whenever the process or the machine stops.

``manifest.json`` says what the job is, ``pairs.jsonl`` its pairs, ``rows/`` their rows, a file a shard. A row is one
line, appended by one write and flushed to the disk; a line cut short by a kill is dropped by the next start.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from idam.batch.pairs import Pair, shard_of
from idam.batch.rows import Row
from idam.errors import InputError
from idam.io.files import StrPath, make_folder, one_line, read_bytes, write_json, write_text

__all__ = ["Ledger", "read_run"]

MANIFEST, PAIRS, ROWS = "manifest.json", "pairs.jsonl", "rows"


class Ledger:
    """The folder of a batch, open to add the rows of one shard.

    Args:
        folder: made if it is not there.
        job: what the rows depend on beside the pairs: model, options, version; plain values.
        pairs: all pairs of the job.
        shard: which shard of how many, from 1.

    Raises:
        InputError: the folder belongs to another job, cannot be written, or another process is at this shard.
    """

    def __init__(
        self, folder: StrPath, job: Mapping[str, Any], pairs: Iterable[Pair], shard: tuple[int, int] = (1, 1)
    ) -> None:
        self.folder = Path(folder)
        self.pairs = [pair for pair in pairs if shard_of(pair, shard[1]) == shard[0]]
        make_folder(self.folder / ROWS)
        _claim(self.folder, job, pairs)
        self._path = self.folder / ROWS / f"{shard[0]}-of-{shard[1]}.jsonl"
        self._file = _open_to_append(self._path)
        ids = {pair.id for pair in self.pairs}
        self.status = {row["id"]: row["status"] for row in _read_rows(self.folder).values() if row["id"] in ids}

    def todo(self, retry_failed: bool = False) -> list[Pair]:
        """Pairs of the shard without a row, and those that failed where they are to be tried again."""
        done = ("ok",) if retry_failed else ("ok", "failed")
        return [pair for pair in self.pairs if self.status.get(pair.id) not in done]

    def append(self, row: Row) -> None:
        """Add a row, unless the pair has a good one; it is on the disk when this returns.

        Raises:
            InputError: the disk is full, or the folder gone.
        """
        if self.status.get(row["id"]) == "ok":
            return  # an engine that tries a group of pairs again may make some rows twice
        line = (json.dumps(row, allow_nan=False) + "\n").encode()
        size = os.fstat(self._file).st_size
        try:
            written = os.write(self._file, line)
            if written < len(line):  # an almost full disk: the next write says what is wrong
                os.write(self._file, line[written:])
            os.fsync(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, size)
            raise InputError(
                f"{self._path}: cannot be written ({one_line(error)}): make room, and run the same command to go on"
            ) from None
        self.status[row["id"]] = row["status"]

    def __enter__(self) -> Ledger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        os.close(self._file)  # and its lock with it


def read_run(folder: StrPath) -> tuple[list[Row], int]:
    """The rows of a batch in the order of its pairs, and how many pairs have none yet.

    Raises:
        InputError: the folder is not one of a batch, or is damaged.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        raise InputError(f"{folder}: is not the folder of a batch (it has no {MANIFEST}): name the one given as -o")
    try:
        ids = [str(json.loads(line)["id"]) for line in read_bytes(folder / PAIRS).decode().splitlines()]
    except (ValueError, TypeError, KeyError) as error:
        raise (
            error if isinstance(error, InputError) else InputError(f"{folder / PAIRS}: damaged: run the batch anew")
        ) from None
    rows = _read_rows(folder)
    return [rows[name] for name in ids if name in rows], sum(name not in rows for name in ids)


def _claim(folder: Path, job: Mapping[str, Any], pairs: Iterable[Pair]) -> None:
    """Write what the job is into a new folder; check that an old one is of the same job."""
    lines = "".join(json.dumps(pair.given()) + "\n" for pair in pairs)
    job = {**job, "pairs": hashlib.sha256(lines.encode()).hexdigest()}
    if not (folder / MANIFEST).exists():
        write_text(folder / PAIRS, lines)
        write_json(folder / MANIFEST, job)
    try:
        found = json.loads(read_bytes(folder / MANIFEST))
        changed = [name for name in {**found, **job} if found.get(name) != job.get(name)]
    except (ValueError, TypeError):
        raise InputError(f"{folder / MANIFEST}: damaged: choose another folder") from None
    if changed:
        name = changed[0]
        what = "other pairs" if name == "pairs" else f"{name} {_shown(found.get(name))}, not {_shown(job.get(name))}"
        raise InputError(f"{folder}: holds another job ({what}): choose another folder, or do the same job")


def _shown(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 100 else text[:12] + "..."


def _open_to_append(path: Path) -> int:
    """Open the rows of a shard, for this process alone, without the line that a kill cut short."""
    try:
        file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        _lock(file, path)
        data = path.read_bytes()
        os.ftruncate(file, data.rfind(b"\n") + 1)
        os.fsync(file)
        _flush_folder(path.parent)
    except InputError:
        os.close(file)
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({one_line(error)}): choose another folder") from None
    return file


def _lock(file: int, path: Path) -> None:
    """Take a file for this process until it closes it or ends, however it ends."""
    if os.name == "nt":
        return  # there an open file cannot be deleted, but two processes at one shard are not refused
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"{path}: another process is at this shard: wait for it, or stop it first") from None
    except OSError:
        return  # a file system without locks


def _flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk as well."""
    if os.name == "nt":
        return  # folders cannot be opened there
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read_rows(folder: Path) -> dict[str, Row]:
    """The rows of all shards by id; of two with one id a good one, or else the later."""
    rows: dict[str, Row] = {}
    for path in sorted((folder / ROWS).glob("*.jsonl")):
        for row in _lines(path):
            if row["id"] not in rows or rows[row["id"]]["status"] != "ok":
                rows[row["id"]] = row
    return rows


def _lines(path: Path) -> Iterator[Row]:
    """The whole lines of a file; another process may be writing the last."""
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            try:
                row = json.loads(line)
                row["status"], {row["id"]}
            except (ValueError, TypeError, KeyError):
                raise InputError(f"{path}, line {number}: damaged: delete the line, and run again") from None
            yield row
