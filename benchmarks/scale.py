"""Time and memory of ``idam.register`` as the clouds grow.

    python benchmarks/scale.py [--points 1000 10000 100000 1000000] [--repeats 3] [--seed 0] [--json FILE]

Each pair is two views of one part made here, sampled independently, cropped by a half-space each and noisy, so that no
data is needed. Each size has a process of its own, whose peak memory is Python, what this script imports, both clouds
and all the work; the CPU's seconds, over all threads, say more than the clock's where other programs run.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import idam
from idam.lab.data.parts import View, partial_views, random_part
from idam.lab.evaluation.metrics import motion_error

KEEP = 0.75
"""Share of the surface in each view."""
NOISE = 0.002
"""Sigma on every coordinate of a part as large as the unit sphere."""
WARM_UP = 1000
"""Points of the first registration, which reads the weights and is not counted."""


@dataclass(frozen=True)
class Measured:
    """One row: medians over the repeats; the error in degrees and in shares of the part's radius."""

    points: int
    seconds: float
    cpu_seconds: float
    peak_gigabytes: float
    degrees: float
    shift: float
    confidence: float


def make_view(points: int, seed: int) -> View:
    """Two views of about ``points`` points each."""
    rng = np.random.default_rng(seed)
    return partial_views(random_part(rng), rng, round(points / KEEP), KEEP, NOISE)


def measure(folder: str, repeats: int) -> Measured:
    """Register the pair saved in a folder, in a process that has done nothing else."""
    source, target, truth = (np.load(Path(folder) / f"{name}.npy") for name in ("source", "target", "truth"))
    rng = np.random.default_rng(0)
    idam.register(*(rng.choice(cloud, min(WARM_UP, len(cloud)), replace=False) for cloud in (source, target)))
    times = []
    for _ in range(repeats):
        started = time.perf_counter(), time.process_time()
        result = idam.register(source, target)
        times.append((time.perf_counter() - started[0], time.process_time() - started[1]))
    seconds, cpu_seconds = map(statistics.median, zip(*times, strict=True))
    degrees, shift = motion_error(result.transformation, truth, source.mean(0))
    return Measured(len(source), seconds, cpu_seconds, peak_gigabytes(), degrees, shift, result.confidence)


def peak_gigabytes() -> float:
    """The most memory this process has had, which Linux tells in KiB and macOS in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def measure_apart(points: int, seed: int, repeats: int) -> Measured:
    """A size measured in a fresh process; the pair is made in this one, so that making it counts nowhere."""
    view = make_view(points, seed)
    with tempfile.TemporaryDirectory() as folder:
        for name, array in (("source", view.source), ("target", view.target), ("truth", view.transformation)):
            np.save(Path(folder) / f"{name}.npy", array)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            return process.submit(measure, folder, repeats).result()


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print("| points, each | seconds | CPU seconds | peak GB | error, degrees | error, of the radius | confidence |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    rows = []
    for points in arguments.points:
        row = measure_apart(points, arguments.seed, arguments.repeats)
        rows.append(asdict(row))
        print(
            f"| {row.points:,} | {row.seconds:.2f} | {row.cpu_seconds:.2f} | {row.peak_gigabytes:.2f} "
            f"| {row.degrees:.3f} | {row.shift:.5f} | {row.confidence:.2f} |",
            flush=True,
        )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
