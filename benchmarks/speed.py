"""Time of one registration by each row of the tables, interleaved in one run.

    python benchmarks/speed.py [--points 1024 2048 4096] [--repeats 15] [--methods NAME ...] [--json FILE]

The pairs follow the paper's protocol on a part made here, so that no data is needed. Every repeat times
every method once, in turn, and the table gives medians: on a busy machine compare within a run, never across runs.
"""

from __future__ import annotations

import argparse
import json
import shlex
import statistics
import sys
import time
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from idam.errors import MissingDependencyError
from idam.lab.data.pairs import MAX_ANGLE
from idam.lab.evaluation.methods import Method, build_method, rows_of
from idam.lab.evaluation.record import processor
from idam.network.geometry import euler_xyz_to_rotation

Points = NDArray[np.float32]
ENDLESS = ("go-icp",)
"""Rows that take a minute a pair; name them to time them."""


def make_pair(points: int, seed: int) -> tuple[Points, Points]:
    """Two clouds of ``points`` points each by the paper's protocol: a part and its turned copy, both cropped to 3/4."""
    rng = np.random.default_rng(seed)
    part = trimesh.util.concatenate(
        [
            trimesh.creation.box((1.2, 0.7, 0.3)),
            trimesh.creation.cylinder(0.25, 0.8).apply_translation((0.3, 0.1, 0.4)),
            trimesh.creation.icosphere(3, 0.3).apply_translation((-0.45, -0.2, 0.25)),
        ]
    )
    source = np.asarray(trimesh.sample.sample_surface(part, 4 * points // 3, seed=seed)[0])
    angles = torch.from_numpy(rng.uniform(0, MAX_ANGLE, 3))
    target = source @ euler_xyz_to_rotation(angles).numpy().T + 0.1
    direction = rng.normal(size=3)
    crops = [rng.permutation(cloud[np.argsort(cloud @ direction)[:points]]) for cloud in (source, target)]
    return crops[0].astype(np.float32), crops[1].astype(np.float32)


def build_methods(names: list[str]) -> dict[str, Method]:
    """Each row's method, with the weights for clean pairs; without those that cannot run here, which say why."""
    methods: dict[str, Method] = {}
    for name in names:
        try:
            methods[name] = build_method(name)
        except MissingDependencyError as error:
            print(f"{name}: {error}")
    return methods


def measure(methods: dict[str, Method], points: int, repeats: int) -> dict[str, float]:
    """Median milliseconds of each method on clouds of ``points`` points."""
    times: dict[str, list[float]] = {name: [] for name in methods}
    for repeat in range(repeats + 1):
        pair = make_pair(points, seed=repeat)
        for name, method in methods.items():
            started = time.perf_counter()
            method(*pair)
            if repeat > 0:  # the first warms up
                times[name].append((time.perf_counter() - started) * 1000)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[1024, 2048, 4096])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument(
        "--methods", nargs="+", default=[name for name in rows_of("unseen-shapes") if name not in ENDLESS]
    )
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    methods = build_methods(arguments.methods)
    results = {points: measure(methods, points, arguments.repeats) for points in arguments.points}
    width = max(map(len, methods))
    print(f"{'median ms':<{width}}" + "".join(f"{points:>10}" for points in results))
    for name in methods:
        print(f"{name:<{width}}" + "".join(f"{results[points][name]:>10.1f}" for points in results))
    if arguments.json is not None:
        about = {
            "command": shlex.join(["python", *sys.argv]),
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "processor": processor(),
            "threads": torch.get_num_threads(),
        }
        arguments.json.write_text(json.dumps({**about, "median_ms": results}, indent=1))


if __name__ == "__main__":
    main()
