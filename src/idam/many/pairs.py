"""Registering pairs of scans, on as many cores as wanted, each pair once: what is done is kept."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from idam.clouds.prepared import Prepared
from idam.errors import InputError
from idam.io.files import StrPath, one_line
from idam.many.scans import Scan
from idam.processes import Row, Worker
from idam.rigid import Array

__all__ = ["Kept", "Pair", "Row", "Workers", "register_pairs"]

Pair = tuple[int, int]
"""Numbers of a source and a target."""
Task = tuple[Pair, dict[str, Any]]
"""A pair, and with which options of :func:`idam.register`."""


@dataclass
class Kept:
    """Registered pairs in a file of JSON lines, one appended as soon as it is done; without a file, in memory.

    A run that was stopped finds what it had: a line is found by the fingerprints of its scans and the options, and one
    that was cut short is no line.

    Attributes:
        path: the file, or None.
    """

    path: StrPath | None = None
    rows: dict[str, Row] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path is None:
            return
        try:
            text = Path(self.path).read_text("utf-8") if Path(self.path).exists() else ""
        except (OSError, ValueError) as error:
            raise InputError(
                f"{self.path}: cannot be read ({one_line(error)}): remove it, or write elsewhere"
            ) from None
        for line in text.split("\n")[:-1]:  # what follows the last line's end was cut short
            try:
                row = json.loads(line)
                if _is_whole(row):
                    self.rows[row["key"]] = row
            except (ValueError, TypeError, KeyError):
                continue
        if text and not text.endswith("\n"):
            self._append("\n")

    def add(self, key: str, row: Row) -> None:
        """Keep a row under a key."""
        self.rows[key] = {"key": key, **row}
        if self.path is not None:
            self._append(json.dumps(self.rows[key]) + "\n")

    def _append(self, text: str) -> None:
        assert self.path is not None
        try:
            with Path(self.path).open("a", encoding="utf-8") as stream:
                stream.write(text)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({one_line(error)}): write elsewhere") from None


def register_pairs(
    scans: Sequence[Scan],
    pairs: Sequence[Pair],
    options: dict[str, Any],
    guesses: Mapping[Pair, Array],
    kept: Kept,
    workers: Workers,
    progress: Callable[[str, int, int], None],
) -> dict[Pair, Row]:
    """Register pairs of scans, less those that are kept already.

    Args:
        scans: all of them.
        pairs: their numbers.
        options: of :func:`idam.register`.
        guesses: transforms (4, 4) to consider, by pair.
        kept: what is known already, and where the rest goes.
        workers: that register them.
        progress: called with what is done, and how many of how many.

    Returns:
        A row for each pair: what registered, or the one line that says why it did not.
    """
    asked = {pair: options | ({"init": guesses[pair].tolist()} if pair in guesses else {}) for pair in pairs}
    keys = {pair: key_of(scans[pair[0]], scans[pair[1]], asked[pair]) for pair in pairs}
    rows = {pair: kept.rows[keys[pair]] for pair in pairs if keys[pair] in kept.rows}
    progress("pairs registered", len(rows), len(pairs))
    for pair, row in workers.rows([(pair, asked[pair]) for pair in pairs if pair not in rows]):
        rows[pair] = {"source": scans[pair[0]].name, "target": scans[pair[1]].name, **row}
        if not row.get("again"):
            kept.add(keys[pair], rows[pair])
        progress("pairs registered", len(rows), len(pairs))
    return rows


def _is_whole(row: Row) -> bool:
    """Whether a row says what a merge needs to know: a pair whose line was damaged is registered anew."""
    if row["error"]:
        return isinstance(row["error"], str)
    shapes = {"transformation": (4, 4), "information": (6, 6), "confidence": (), "reach": ()}
    numbers = {name: np.array(row[name], np.float64) for name in shapes}
    return all(numbers[name].shape == shape and np.isfinite(numbers[name]).all() for name, shape in shapes.items())


def key_of(source: Scan, target: Scan, options: dict[str, Any]) -> str:
    """What a registration depends on."""
    from idam import __version__

    return "-".join([source.fingerprint, target.fingerprint, __version__, json.dumps(options, sort_keys=True)])


class Workers:
    """Processes that register pairs of scans; with one, this process does.

    They last until they are closed, and each keeps what it has worked out about a scan. One that dies costs its pair at
    most: a new one tries it again.

    Args:
        scans: all of them.
        jobs: processes.
    """

    def __init__(self, scans: Sequence[Scan], jobs: int):
        self._build, self._jobs = partial(Register, [scan.prepared for scan in scans]), jobs
        self._workers: list[Worker[Task]] = []

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.stop()

    def rows(self, tasks: Sequence[Task]) -> Iterator[tuple[Pair, Row]]:
        """Each task's pair and its row, as soon as it is done."""
        if self._jobs == 1 or (not self._workers and len(tasks) == 1):
            register = self._build()
            yield from ((task[0], register(task)) for task in tasks)
            return
        while len(self._workers) < min(self._jobs, len(tasks)):
            self._workers.append(Worker(self._build, failed_row))
        waiting, busy = deque(tasks), dict[Worker[Task], Pair]()
        while waiting or busy:
            for worker in self._workers:
                if worker.free and waiting:
                    busy[worker] = waiting[0][0]
                    worker.give(waiting.popleft())
            Worker.wait(list(busy))
            for worker in list(busy):
                if (row := worker.take()) is not None:
                    yield busy.pop(worker), row


@dataclass
class Register:
    """Registers pairs of scans; what goes wrong is in the row.

    Attributes:
        scans: all of them.
    """

    scans: Sequence[Prepared]

    def __call__(self, task: Task) -> Row:
        """The row of a task."""
        import idam

        (source, target), options = task
        try:
            result = idam.register(self.scans[source], self.scans[target], **options)
        except Exception as error:  # a bad pair must not cost the others
            return {"error": one_line(error)}
        return {
            "error": "",
            "transformation": result.transformation.tolist(),
            "information": result.information.tolist(),
            "confidence": result.confidence,
            "reason": result.reason,
            "overlap": result.fitness,
            "residual": result.inlier_rmse,
            "reach": result.max_correspondence_distance,
        }


def failed_row(_: Task, error: str, __: float) -> Row:
    """The row of a pair whose process died: another run tries it again."""
    return {"error": error, "again": True}
