"""The engine for one machine: processes of the standard library."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator

from idam.batch.pairs import Pair
from idam.batch.rows import Row, failed_row
from idam.batch.work import Work
from idam.processes import Worker, cores

__all__ = ["TIME_LIMIT", "run"]

TIME_LIMIT = 600.0
"""Seconds a pair may take unless told otherwise: hundreds of times what a pair of a million points each takes."""

RUN = 32
"""Pairs that a process takes at a time, at most, so that it finds their scans among those it kept; fewer near the end,
so that none is left with work while others wait."""


def run(
    pairs: Iterable[Pair], build: Callable[[], Work], jobs: int | None = None, limit: float = TIME_LIMIT
) -> Iterator[Row]:
    """The rows of pairs, as they are made.

    Args:
        pairs: ordered by scan.
        build: makes the work, in each process.
        jobs: processes; None for as many as there are cores to use.
        limit: seconds that a pair may take.
    """
    waiting = deque(pairs)
    jobs = min(jobs or cores(), len(waiting))
    workers = [Worker(build, failed_row, limit) for _ in range(jobs)]
    shares: dict[Worker[Pair], deque[Pair]] = {worker: deque() for worker in workers}

    def feed(worker: Worker[Pair]) -> None:
        share = shares[worker]
        if not share:
            share.extend(waiting.popleft() for _ in range(min(RUN, -(-len(waiting) // (4 * jobs)))))
        if share:
            worker.give(share.popleft())

    try:
        for worker in workers:
            feed(worker)
        while not all(worker.free for worker in workers):
            Worker.wait(workers)
            for worker in workers:
                row = worker.take()
                if row is not None:
                    feed(worker)  # first, so that it is at work while the row is written
                    yield row
    finally:
        for worker in workers:
            worker.stop()
