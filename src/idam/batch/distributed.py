"""The engine for many machines: Ray Data, over actors that each keep a worker process, as one machine does."""

from __future__ import annotations

import json
import logging
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from idam.batch.local import TIME_LIMIT
from idam.batch.pairs import Pair
from idam.batch.rows import Row, failed_row
from idam.batch.work import Work
from idam.errors import InputError, MissingDependencyError
from idam.io.files import one_line
from idam.processes import Worker

__all__ = ["run"]

BLOCK = 8
"""Pairs of a task: what is done again when a machine dies, and how many rows reach the ledger at a time."""


def run(
    pairs: Sequence[Pair],
    build: Callable[[], Work],
    jobs: int | None = None,
    limit: float = TIME_LIMIT,
    address: str | None = None,
) -> Iterator[Row]:
    """The rows of pairs, as they are made: :func:`idam.batch.local.run` on a Ray cluster.

    Args:
        pairs: ordered by scan, with paths that every machine can read.
        build: makes the work, in each process.
        jobs: actors, of one core each; None for as many as the cluster has or gets cores for.
        limit: seconds that a pair may take.
        address: of the cluster; ``auto`` for the one this machine is in, None to start one here.

    Raises:
        MissingDependencyError: Ray is not installed.
        InputError: there is no cluster at the address, or it failed for good.
    """
    try:
        import ray
        import ray.data
    except ImportError:
        raise MissingDependencyError("the engine ray needs Ray Data: pip install 'idam[ray]'") from None
    if not pairs:
        return
    own = not ray.is_initialized()
    if own:
        try:
            ray.init(address, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # Ray raises bare ones, too
            raise InputError(f"Ray cannot be reached or started ({one_line(error)}): check its address") from error
    try:
        logging.getLogger("ray.data").setLevel(logging.ERROR)
        ray.data.DataContext.get_current().enable_progress_bars = False
        blocks = -(-len(pairs) // BLOCK)
        rows = ray.data.from_items(
            [{"pair": pickle.dumps(pair)} for pair in pairs], override_num_blocks=blocks
        ).map_batches(
            _Actor,
            fn_constructor_kwargs={"build": build, "limit": limit},
            batch_size=None,
            num_cpus=1,
            compute=ray.data.ActorPoolStrategy(min_size=min(jobs or 1, blocks), max_size=min(jobs or blocks, blocks)),
        )
        for batch in rows.iter_batches(batch_size=None):
            yield from map(json.loads, batch["row"])
    except ray.exceptions.RayError as error:
        raise InputError(f"Ray: {one_line(error)}: check the cluster, and run the same command to go on") from error
    finally:
        if own:
            ray.shutdown()


class _Actor:
    """Holds a worker process, and with it the model and the scans it kept."""

    def __init__(self, build: Callable[[], Work], limit: float) -> None:
        self._worker = Worker(build, failed_row, limit)

    def __call__(self, batch: dict[str, Any]) -> dict[str, list[str]]:
        return {"row": [json.dumps(self._row(pickle.loads(pair))) for pair in batch["pair"]]}

    def _row(self, pair: Pair) -> Row:
        self._worker.give(pair)
        while True:
            Worker.wait([self._worker])
            row = self._worker.take()
            if row is not None:
                return row
