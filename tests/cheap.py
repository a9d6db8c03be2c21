"""Work that costs nothing, for tests of what surrounds it; :func:`main` is a batch of it to kill and start again.

What a pair does is in the name of its source: ``die`` kills the process, ``once`` does the first time, ``hang`` never
ends, ``slow`` takes a while.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import signal
import sys
import time
from importlib import import_module
from pathlib import Path

from idam.batch.ledger import Ledger
from idam.batch.pairs import Pair, by_scan, read_pairs
from idam.batch.rows import COLUMNS, Row, failed_row

ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([*map(os.path.abspath, sys.path), str(Path(__file__).parent)]),
    "RAY_worker_niceness": "0",  # else a busy machine leaves them no time
}
"""For processes of tests, which import this."""


class Cheap:
    """Rows made of the pair's name alone, so that they are the same whoever makes them."""

    def __call__(self, pair: Pair) -> Row:
        if pair.source.startswith("bad"):
            return failed_row(pair, f"{pair.source}: damaged", 0.0)
        mark = Path(pair.folder) / f"{pair.source}.begun"
        first = not mark.exists()
        if pair.source.startswith("once"):
            mark.touch()
        if pair.source.startswith("die") or (pair.source.startswith("once") and first):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep({"hang": 3600.0, "slow": 0.05}.get(pair.source[:4], 0.001))
        digest = hashlib.sha256(pair.id.encode()).digest()
        known = {"id": pair.id, "source": pair.source, "target": pair.target, "status": "ok", "seconds": time.time()}
        known |= {"confidence": digest[0] / 255, "transformation": [[float(byte) for byte in digest[:16]]] * 40}
        return {name: known.get(name) for name in COLUMNS}


class Named(Cheap):
    """Cheap work on the file name of the source."""

    def __call__(self, pair: Pair) -> Row:
        return super().__call__(Pair(pair.id, Path(pair.source).name, "t", folder=str(Path(pair.source).parent)))


class Threads(Cheap):
    """Rows that say how many threads libraries may start."""

    def __call__(self, pair: Pair) -> Row:
        return super().__call__(pair) | {"reason": os.environ.get("OMP_NUM_THREADS")}


def settled(rows: list[Row]) -> dict[str, Row]:
    """Rows by id, without what differs from run to run; no id may be there twice."""
    by_id = {row["id"]: row | {"seconds": None} for row in rows}
    assert len(by_id) == len(rows)
    return by_id


def main() -> None:
    """Run a batch of cheap work."""
    parser = argparse.ArgumentParser()
    parser.add_argument("pairs")
    parser.add_argument("folder")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--shard", type=int, nargs=2, default=(1, 1))
    parser.add_argument("--engine", choices=("local", "distributed"), default="local")
    args = parser.parse_args()
    engine = import_module(f"idam.batch.{args.engine}")
    with Ledger(args.folder, {"work": "cheap"}, read_pairs(args.pairs), tuple(args.shard)) as ledger:
        for row in engine.run(by_scan(ledger.todo()), Cheap, args.jobs):
            ledger.append(row)
