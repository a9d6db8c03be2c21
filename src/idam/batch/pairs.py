"""The pairs of a batch: from a table, a list of names, or Python."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError
from idam.io.files import StrPath, read_bytes

__all__ = ["BLOCK", "Pair", "as_pairs", "by_scan", "read_pairs", "shard_of"]

COLUMNS = ("id", "source", "target", "init", "max_angle", "voxel_size")
"""What a pair may say about itself."""

BLOCK = 10
"""Scans to a side of a block of pairs. All pairs of n scans then cost a process that keeps three times as many n^2 / 20
readings; in the order of a list, they cost n^2 / 2."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds to register.

    Attributes:
        id: what its row is kept under, unique within a batch.
        source: the path as it was given, or a cloud in memory.
        target: likewise.
        init: a guess of the transform: the path of one as it was given, or (4, 4); None for none.
        max_angle: degrees of rotation at most; None for the batch's.
        voxel_size: in the clouds' units; None for the batch's.
        folder: what paths are relative to.
        scans: numbers of the source and the target among the scans of the batch (:func:`by_scan`).
    """

    id: str
    source: Any
    target: Any
    init: Any = None
    max_angle: float | None = None
    voxel_size: float | None = None
    folder: str = ""
    scans: tuple[int, int] = (0, 0)

    def given(self) -> dict[str, Any]:
        """The pair as it was given, for JSON; a cloud in memory has no name."""
        values = {name: getattr(self, name) for name in COLUMNS}
        return {name: value if is_plain(value) else None for name, value in values.items()}

    def path(self, name: Any) -> str:
        """Where a file of the pair is."""
        return os.path.join(self.folder, name)  # noqa: PTH118 - a Path would drop a leading ./


def is_plain(value: Any) -> bool:
    """Whether JSON holds a value of a pair as it is."""
    return value is None or isinstance(value, str | float | list)


def read_pairs(path: StrPath) -> list[Pair]:
    """Read pairs: CSV with a header, JSONL, or text with two names a line; ``-`` is standard input.

    The columns are ``source`` and ``target`` and, where wanted, ``id``, ``init``, ``max_angle`` and ``voxel_size``.
    Paths are relative to the file's folder, from standard input to the working folder.

    Raises:
        InputError: the file cannot be read, a column is unknown, a value is wrong, or a pair is there twice.
    """
    piped = os.fspath(path) == "-"
    data = sys.stdin.buffer.read() if piped else read_bytes(path)
    name = "standard input" if piped else os.fspath(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{name}: is not UTF-8 text: give pairs as CSV, JSONL or two names a line") from None
    folder = str(Path.cwd() if piped else Path(path).absolute().parent)
    records = ((f"{name}, line {line}", record) for line, record in _reader(text, name)(text))
    return _checked(records, folder, name)


def as_pairs(pairs: Any) -> list[Pair]:
    """Pairs of a file's path, or of an iterable of ``(source, target)`` or of mappings with the columns of a file.

    Raises:
        InputError: as :func:`read_pairs`.
    """
    if isinstance(pairs, str | os.PathLike):
        return read_pairs(pairs)
    return _checked(_from_python(pairs), str(Path.cwd()), "pairs")


def by_scan(pairs: Iterable[Pair]) -> list[Pair]:
    """The pairs, their scans numbered, in an order in which those of the same scans follow one another."""
    numbers: dict[Any, int] = {}

    def number(pair: Pair, cloud: Any) -> int:
        return numbers.setdefault(pair.path(cloud) if isinstance(cloud, str) else id(cloud), len(numbers))

    numbered = [replace(pair, scans=(number(pair, pair.source), number(pair, pair.target))) for pair in pairs]
    return sorted(numbered, key=lambda pair: (pair.scans[0] // BLOCK, pair.scans[1] // BLOCK, pair.scans))


def shard_of(pair: Pair, shards: int) -> int:
    """Which of so many shards a pair is in, from 1: by its id alone, so that shards need not know of one another."""
    return int.from_bytes(hashlib.sha256(pair.id.encode(errors="surrogatepass")).digest()[:8], "big") % shards + 1


Records = Iterator[tuple[int, Mapping[str, Any]]]


def _reader(text: str, name: str) -> Callable[[str], Records]:
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    if first.startswith("{"):
        return lambda text: _read_jsonl(text, name)
    if {"source", "target"} <= {word.strip() for word in first.split(",")}:
        return lambda text: _read_csv(text, name)
    return lambda text: _read_names(text, name)


def _read_jsonl(text: str, name: str) -> Records:
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            record = json.loads(line)
        except ValueError:
            record = None
        if not isinstance(record, dict):
            raise InputError(f'{name}, line {number}: expected a JSON object like {{"source": "a.ply", ...}}')
        yield number, record


def _read_csv(text: str, name: str) -> Records:
    rows = csv.reader(io.StringIO(text), strict=True)
    header: list[str] = []
    try:
        for row in rows:
            words = [word.strip() for word in row]
            if not any(words):
                continue
            if not header:
                header = words
            elif len(words) != len(header):
                raise InputError(
                    f"{name}, line {rows.line_num}: {len(words)} values under {len(header)} columns: "
                    "put names with commas in double quotes"
                )
            else:
                yield rows.line_num, {key: word for key, word in zip(header, words, strict=True) if word}
    except csv.Error as error:
        raise InputError(f"{name}, line {rows.line_num}: is not CSV ({error}): export it again") from None


def _read_names(text: str, name: str) -> Records:
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if len(words) not in (0, 2):
            raise InputError(
                f"{name}, line {number}: expected two names: for other columns or names with spaces use CSV with a "
                "header source,target"
            )
        if words:
            yield number, {"source": words[0], "target": words[1]}


def _from_python(pairs: Iterable[Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for number, pair in enumerate(pairs):
        if isinstance(pair, Mapping):
            yield f"pair {number}", pair
        elif isinstance(pair, list | tuple) and len(pair) == 2:
            yield f"pair {number}", {"source": pair[0], "target": pair[1]}
        else:
            raise InputError(f"pair {number}: expected (source, target), or a mapping with these keys")


def _checked(records: Iterable[tuple[str, Mapping[str, Any]]], folder: str, name: str) -> list[Pair]:
    """Pairs of records, each with the place it stands at, no two with one id."""
    pairs: dict[str, Pair] = {}
    places: dict[str, str] = {}
    for place, record in records:
        pair = _pair(record, place, folder, len(pairs))
        if pair.id in places:
            raise InputError(
                f"{place}: {pair.id!r} stands before, on {places[pair.id]}: give each pair an id of its own"
            )
        pairs[pair.id], places[pair.id] = pair, place
    if not pairs:
        raise InputError(f"{name}: no pairs: give two names a line, or CSV with a header source,target")
    return list(pairs.values())


def _pair(record: Mapping[str, Any], place: str, folder: str, number: int) -> Pair:
    unknown = [str(key) for key in record if key not in COLUMNS]
    if unknown:
        raise InputError(f"{place}: unknown column {unknown[0]!r}: the ones to give are {', '.join(COLUMNS)}")
    source, target = (_cloud(record.get(key), key, place) for key in ("source", "target"))
    name = record.get("id")
    if name is None:
        name = f"{source} {target}" if isinstance(source, str) and isinstance(target, str) else number
    if not isinstance(name, str | int) or str(name).split() == []:
        raise InputError(f"{place}: id must be text or a whole number, not {name!r}")
    return Pair(
        str(name),
        source,
        target,
        _init(record.get("init"), place),
        _number(record.get("max_angle"), "max_angle", place),
        _number(record.get("voxel_size"), "voxel_size", place),
        folder,
    )


def _cloud(value: Any, key: str, place: str) -> Any:
    if value is None or (isinstance(value, str) and not value):
        raise InputError(f"{place}: no {key}: every pair needs a source and a target")
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _init(value: Any, place: str) -> Any:
    """A guess as a path or a nested list (4, 4); text of 16 numbers is one, as tables of results have it."""
    if value is None or isinstance(value, os.PathLike):
        return None if value is None else os.fspath(value)
    numbers = value.split() if isinstance(value, str) else value
    if isinstance(value, str) and len(numbers) != 16:
        return value
    try:
        return np.asarray(numbers, np.float64).reshape(4, 4).tolist()
    except (TypeError, ValueError):
        raise InputError(f"{place}: init must be the path of a 4x4, or its 16 numbers") from None


def _number(value: Any, key: str, place: str) -> float | None:
    if value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or isinstance(value, bool):
        raise InputError(f"{place}: {key} must be a number, not {value!r}")
    return number
