"""Registering pairs of scans, on as many cores as wanted, each pair once: what is done is kept."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError
from idam.io.files import StrPath, one_line
from idam.many.scans import Scan
from idam.rigid import Array

__all__ = ["Kept", "Pair", "Workers", "register_pairs"]

Pair = tuple[int, int]
"""Numbers of a source and a target."""
Row = dict[str, Any]
"""What is known of a registered pair, as plain numbers and lists."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


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

    Raises:
        InputError: a process was killed.
    """
    asked = {pair: options | ({"init": guesses[pair].tolist()} if pair in guesses else {}) for pair in pairs}
    keys = {pair: key_of(scans[pair[0]], scans[pair[1]], asked[pair]) for pair in pairs}
    waiting = [pair for pair in pairs if keys[pair] not in kept.rows]
    ready = len(pairs) - len(waiting)
    progress("pairs registered", ready, len(pairs))
    for pair, row in workers.results({pair: asked[pair] for pair in waiting}):
        kept.add(keys[pair], {"source": scans[pair[0]].name, "target": scans[pair[1]].name, **row})
        ready += 1
        progress("pairs registered", ready, len(pairs))
    return {pair: kept.rows[keys[pair]] for pair in pairs}


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

    They last until they are closed, and each keeps what it has worked out about a scan.

    Args:
        scans: all of them.
        jobs: processes.
    """

    def __init__(self, scans: Sequence[Scan], jobs: int):
        self._prepared, self._jobs = [scan.prepared for scan in scans], jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def results(self, asked: Mapping[Pair, dict[str, Any]]) -> Iterator[tuple[Pair, Row]]:
        """Each pair's row, as soon as it is done, by its options.

        Raises:
            InputError: a process was killed.
        """
        if self._jobs == 1 or (self._pool is None and len(asked) == 1):
            begin(self._prepared)
            for pair, options in asked.items():
                yield pair, register_pair(pair, options)
            return
        with one_thread_each():  # processes start as they are needed
            self._pool = self._pool or ProcessPoolExecutor(
                self._jobs, get_context("spawn"), begin_apart, (self._prepared,)
            )
            futures = {self._pool.submit(register_pair, pair, options): pair for pair, options in asked.items()}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool:
            raise InputError(
                "a process was killed, probably for want of memory: run again with fewer jobs; what is done is kept"
            ) from None


@contextmanager
def one_thread_each() -> Iterator[None]:
    """New processes with a thread each for linear algebra: they share the cores."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_scans: list[Any] = []
"""In each process: all scans, ready to be registered."""


def begin(scans: list[Any]) -> None:
    """Hand a process the scans."""
    _scans[:] = scans


def begin_apart(scans: list[Any]) -> None:
    """Hand a process of its own the scans; it ends with the one that started it, however that ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    begin(scans)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def register_pair(pair: Pair, options: dict[str, Any]) -> Row:
    """Register one pair of the scans that :func:`begin` handed over; what goes wrong is in the row."""
    import idam

    try:
        result = idam.register(_scans[pair[0]], _scans[pair[1]], **options)
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
