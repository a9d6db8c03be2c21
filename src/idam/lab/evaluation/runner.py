"""Running methods over test pairs, in one process or several."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from idam.lab.data.pairs import Pairs
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.methods import Method, build_method
from idam.lab.evaluation.metrics import Metrics, measure, modified_chamfer
from idam.lab.evaluation.symmetry import right_up_to_symmetry

__all__ = ["LIMITS", "Row", "Task", "run"]

LIMITS = {"go-icp": 40}
"""Pairs that a row takes at most where it would run for days: the first ones, and the row says how many."""


@dataclass(frozen=True)
class Task:
    """A row to compute: which method, with which weights and settings."""

    method: str
    model: str | None = None
    settings: tuple[str, ...] = ()

    def build(self) -> Method:
        """The method, ready to register."""
        return build_method(self.method, self.model, self.settings)


@dataclass(frozen=True)
class Row:
    """One method on one set of pairs.

    Attributes:
        task: what ran.
        pairs: on how many.
        metrics: its errors.
        seconds_per_pair: median wall-clock time.
        observable: its errors on the shapes without an axis of symmetry, where the shapes are known.
        chamfer: mean modified Chamfer distance, where the shapes are known.
        symmetric_recall: recall that counts the poses of symmetric shapes that look the same, on pairs of practice.
    """

    task: Task
    pairs: int
    metrics: Metrics
    seconds_per_pair: float
    observable: Metrics | None = None
    chamfer: float | None = None
    symmetric_recall: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """One flat record, for JSON; without what is not known."""
        known: dict[str, Any] = {
            "method": self.task.method,
            "model": self.task.model,
            "settings": list(self.task.settings),
            "pairs": self.pairs,
            **self.metrics.to_dict(),
            "seconds_per_pair": self.seconds_per_pair,
        }
        if self.observable is not None:
            known |= {f"observable_{name}": value for name, value in self.observable.to_dict().items()}
        if self.chamfer is not None:
            known["chamfer"] = self.chamfer
        if self.symmetric_recall is not None:
            known["symmetric_recall"] = self.symmetric_recall
        return known

    @staticmethod
    def from_dict(record: dict[str, Any]) -> Row:
        """The row that :meth:`to_dict` wrote; raise KeyError or TypeError where it did not."""
        names = list(Metrics.__dataclass_fields__)
        seen = all(f"observable_{name}" in record for name in names)
        return Row(
            Task(record["method"], record["model"], tuple(record["settings"])),
            int(record["pairs"]),
            Metrics(**{name: float(record[name]) for name in names}),
            float(record["seconds_per_pair"]),
            Metrics(**{name: float(record[f"observable_{name}"]) for name in names}) if seen else None,
            record.get("chamfer"),
            record.get("symmetric_recall"),
        )


def run(task: Task, test: TestSet, advance: Callable[[], None], jobs: int = 1) -> Row:
    """Register every pair on its own, as a user would, and measure.

    Args:
        task: what registers; built before the first pair.
        test: what to register.
        advance: called after each pair.
        jobs: processes that share the pairs; the times are then those of a busy machine.

    Raises:
        InputError, MissingDependencyError: the method cannot be built, or cannot take these pairs.
    """
    test = test.first(LIMITS.get(task.method, len(test)))
    sources, targets = ([cloud.numpy() for cloud in side] for side in (test.pairs.source, test.pairs.target))
    clouds = list(zip(sources, targets, strict=True))
    estimates, seconds = [], []
    with _registering(task, min(jobs, len(clouds))) as register:
        for estimate, duration in register(clouds):
            estimates.append(estimate)
            seconds.append(duration)
            advance()
    transformation = torch.from_numpy(np.stack(estimates))
    return _measured(task, test, transformation[:, :3, :3], transformation[:, :3, 3], float(np.median(seconds)))


def _measured(task: Task, test: TestSet, rotation: torch.Tensor, translation: torch.Tensor, seconds: float) -> Row:
    found, truth = (rotation, translation), (test.pairs.rotation, test.pairs.translation)
    seen = test.observable
    observable = chamfer = symmetric = None
    if seen is not None and seen.any():
        observable = measure(rotation[seen], translation[seen], truth[0][seen], truth[1][seen], test.within)
    if test.whole is not None and isinstance(test.pairs, Pairs):
        chamfer = modified_chamfer(test.pairs, test.whole, *found)
    if test.whole is not None and test.name.startswith("practice"):
        symmetric = float(right_up_to_symmetry(test.whole, found, truth, test.within).double().mean())
    metrics = measure(*found, *truth, test.within)
    return Row(task, len(test), metrics, seconds, observable, chamfer, symmetric)


Clouds = tuple[NDArray[np.float32], NDArray[np.float32]]
Timed = tuple[NDArray[np.float64], float]


@contextmanager
def _registering(task: Task, jobs: int) -> Iterator[Callable[[Sequence[Clouds]], Iterator[Timed]]]:
    """What registers pair after pair, here or in processes of their own, in the pairs' order."""
    method = task.build()  # here as well: what cannot be built should not fail in every process
    if jobs <= 1:
        yield lambda clouds: (_timed(method, *pair) for pair in clouds)
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    # spawned, for what torch and Open3D have started in this process does not survive a fork
    with ProcessPoolExecutor(jobs, get_context("spawn"), _begin, (task, threads)) as pool:
        yield lambda clouds: pool.map(_timed_there, clouds, chunksize=4)


def _timed(method: Method, source: NDArray[np.float32], target: NDArray[np.float32]) -> Timed:
    started = time.perf_counter()
    estimate = method(source, target)
    return estimate, time.perf_counter() - started


_method: Method


def _begin(task: Task, threads: int) -> None:
    """Start one of several processes."""
    global _method
    torch.set_num_threads(threads)
    _method = task.build()


def _timed_there(clouds: Clouds) -> Timed:
    return _timed(_method, *clouds)
