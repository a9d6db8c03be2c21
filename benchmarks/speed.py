"""Time of one registration by each row of the tables, and of pairs in a batch, interleaved in one run.

    python benchmarks/speed.py [--points 512 1024 2048 4096] [--repeats 10] [--methods NAME ...] [--batch 16]
                               [--device cuda] [--json docs/results/speed.json]

The pairs follow the paper's protocol on a part made here, so that no data is needed. Every repeat times every method
once, in turn, on a pair of its own; the table gives medians and quartiles. On a busy machine compare within a run,
never across runs. The networks also take 16 pairs of 2048 points at once, as the paper measures them. With --device the
networks run there, and nothing else is timed.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from idam.errors import MissingDependencyError
from idam.io import write_json
from idam.lab.data.pairs import MAX_ANGLE
from idam.lab.evaluation.methods import METHODS, Method, build_method, rows_of
from idam.lab.evaluation.methods.network import as_method, load_network
from idam.lab.evaluation.record import processor
from idam.network.geometry import euler_xyz_to_rotation
from idam.network.model import IDAM

Points = NDArray[np.float32]
ENDLESS = ("go-icp",)
"""Rows that take a minute a pair; name them to time them."""
NETWORKS = [name for name, (place, _) in METHODS.items() if place in ("network:gnn", "network:fpfh")]
"""Rows of a network alone, which take many pairs at once, and any device."""
BATCH_POINTS = 2048
"""Points of each cloud of a batch (section 4.5)."""


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


def build_methods(names: list[str], device: str | None) -> dict[str, Method]:
    """Each row's method, with the weights for clean pairs; without those that cannot run here, which say why."""
    methods: dict[str, Method] = {}
    for name in names:
        try:
            methods[name] = build_method(name) if device is None else as_method(load_row(name, device))
        except MissingDependencyError as error:
            print(f"{name}: {error}")
    return methods


def load_row(name: str, device: str | None) -> IDAM:
    """The network of a row of the tables, with the weights for clean pairs."""
    place, settings = METHODS[name]
    features = place.split(":")[1]
    return load_network(features, f"{features}-unseen-shapes", settings, device)


def batch_of(network: IDAM) -> Callable[[Sequence[Points], Sequence[Points]], None]:
    """Registers many pairs of equally large clouds at once."""
    device = next(network.parameters()).device

    @torch.inference_mode()
    def run(sources: Sequence[Points], targets: Sequence[Points]) -> None:
        output = network(*(torch.from_numpy(np.stack(clouds)).to(device) for clouds in (sources, targets)))
        output.rotation.cpu()  # waits for the device

    return run


def measure(calls: Mapping[str, Callable[..., object]], inputs: Iterable[tuple[Any, Any]]) -> dict[str, list[float]]:
    """Milliseconds of each call on each input but the first, which warms up; all calls in turn."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for n, given in enumerate(inputs):
        for name, call in calls.items():
            started = time.perf_counter()
            call(*given)
            if n > 0:
                times[name].append((time.perf_counter() - started) * 1000)
    return times


def summarise(times: dict[str, list[float]], pairs: int = 1) -> tuple[dict[str, float], dict[str, list[float]]]:
    """The median and the quartiles of each, for each of so many pairs."""
    quartiles = {
        name: [value / pairs for value in np.quantile(some, (0.25, 0.5, 0.75))] for name, some in times.items()
    }
    return {name: q[1] for name, q in quartiles.items()}, {name: [q[0], q[2]] for name, q in quartiles.items()}


def main() -> None:
    """Measure and print."""
    arguments = parse()
    methods = build_methods(arguments.methods, arguments.device)
    medians, quartiles = {}, {}
    for points in arguments.points:
        times = measure(methods, (make_pair(points, seed) for seed in range(arguments.repeats + 1)))
        medians[points], quartiles[points] = summarise(times)
    show("median ms (quartiles)", medians, quartiles)
    batches = {name: batch_of(load_row(name, arguments.device)) for name in methods if name in NETWORKS}
    sources, targets = zip(*(make_pair(BATCH_POINTS, seed) for seed in range(arguments.batch)), strict=True)
    times = measure(batches, repeat((sources, targets), arguments.repeats + 1))
    batch, batch_quartiles = summarise(times, arguments.batch)
    show(f"ms a pair, {arguments.batch} at once", {BATCH_POINTS: batch}, {BATCH_POINTS: batch_quartiles})
    if arguments.json is not None:
        about = {
            "command": shlex.join(["python", *sys.argv]),
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "processor": processor(),
            "device": arguments.device or "cpu",
            "threads": torch.get_num_threads(),
            "repeats": arguments.repeats,
        }
        batched = {
            "pairs": arguments.batch,
            "points": BATCH_POINTS,
            "median_ms": batch,
            "quartiles_ms": batch_quartiles,
        }
        write_json(arguments.json, {**about, "median_ms": medians, "quartiles_ms": quartiles, "batched": batched})


def parse() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[512, 1024, 2048, 4096])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--methods", nargs="+", help="rows of the tables; all that take less than a minute a pair")
    parser.add_argument("--batch", type=int, default=16, help="pairs at once")
    parser.add_argument("--device", help="of the networks, for example cuda")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.methods is None:
        rows = [name for name in rows_of("unseen-shapes") if name not in ENDLESS]
        arguments.methods = rows if arguments.device is None else [name for name in rows if name in NETWORKS]
    return arguments


def show(title: str, medians: dict[int, dict[str, float]], quartiles: dict[int, dict[str, list[float]]]) -> None:
    """Print a table with a column for each number of points."""
    names = list(next(iter(medians.values())))
    width = max(map(len, (title, *names)))
    print(f"{title:<{width}}" + "".join(f"{points:>24}" for points in medians))
    for name in names:
        cells = (
            f"{medians[p][name]:.1f} ({quartiles[p][name][0]:.1f} to {quartiles[p][name][1]:.1f})" for p in medians
        )
        print(f"{name:<{width}}" + "".join(f"{cell:>24}" for cell in cells))


if __name__ == "__main__":
    main()
