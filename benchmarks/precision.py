"""How well the covariance tells the error: NEES of repeated registrations, 6 where it is right.

    python benchmarks/precision.py [--points 1000 10000 100000 1000000] [--repeats 10] [--loops FOLDER] [--json FILE]

Each pair is two samplings of one shape, each of three quarters of it, with noise: a dented sphere, a corner of walls
along the axes, parts. Loops are three scans A, B, C of a folder with a ``pairs.json``: A to B to C against A to C, all
three covariances carried to one frame. Answers that are wrong altogether, more than 3 degrees off, are counted apart.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

import idam
from idam import rigid
from idam.io import read_point_cloud
from idam.lab.data.parts import random_part, sample_surface
from idam.lab.evaluation.record import processor
from idam.rigid import Array

Shape = Callable[[np.random.Generator, int], Array]
NOISES = (0.0005, 0.002, 0.01)
"""Standard deviations of every coordinate; shapes are about as large as the unit sphere."""
KEEP = 0.75
"""Share of the shape in each cloud."""
WRONG = np.radians(3.0)
"""Error from which an answer is wrong altogether, which the confidence tells, not the covariance."""


def blob(rng: np.random.Generator, count: int) -> Array:
    """Points (N, 3) of a sphere with dents and bumps."""
    way, middles = rng.normal(size=(count, 3)), np.random.default_rng(5).normal(size=(12, 3))
    way, middles = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (way, middles))
    height = np.random.default_rng(6).uniform(-0.3, 0.3, 12)
    return np.asarray(0.8 * way * (1 + np.exp((way @ middles.T - 1) / 0.12) @ height)[:, None])


def corner(rng: np.random.Generator, count: int) -> Array:
    """Points (N, 3) of three walls along the axes and a small box that is turned against them."""
    points = rng.uniform(-0.7, 0.7, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = -0.7
    size = np.array([0.2, 0.15, 0.3])
    box, side = rng.uniform(-1, 1, (count // 8, 3)) * size, rng.integers(0, 3, count // 8)
    box[np.arange(len(box)), side] = rng.choice([-1, 1], len(box)) * size[side]
    points[: len(box)] = box @ rigid.rotation_exp(np.array([0, 0, 0.5])).T + [0.2, -0.1, -0.4]
    return points


def part(seed: int) -> Shape:
    """A mechanical part."""
    mesh = random_part(np.random.default_rng(seed))
    return lambda rng, count: sample_surface(mesh, count, rng)


def views(shape: Shape, count: int, noise: float, seed: int) -> tuple[Array, Array, Array]:
    """Source and target of about ``count`` points each, and the transform between them."""
    rng = np.random.default_rng([seed, count])
    truth = rigid.exp(rng.uniform(-1, 1, 6))
    clouds = []
    for way in np.random.default_rng(77).normal(size=(2, 3)):
        points = shape(rng, round(count / KEEP))
        along = points @ way
        points = points[along <= np.quantile(along, KEEP)]
        clouds.append(points + noise * rng.normal(size=points.shape))
    return clouds[0], rigid.apply(truth, clouds[1]), truth


def repeated(shape: Shape, count: int, noise: float, repeats: int) -> list[float | None]:
    """NEES of each repeat; None where the answer is wrong altogether."""
    found: list[float | None] = []
    for seed in range(repeats):
        source, target, truth = views(shape, count, noise, seed)
        result = idam.register(source, target, init=truth, max_angle=5)
        error = rigid.log(rigid.inverse(result.transformation) @ truth)
        wrong = np.linalg.norm(error[:3]) > WRONG
        found.append(None if wrong else float(error @ result.information @ error))
    return found


def loops(folder: Path) -> Iterator[float]:
    """NEES of each loop of three scans of which all pairs are known, and registered rightly."""
    about = json.loads((folder / "pairs.json").read_text())
    links: dict[tuple[str, str], tuple[Array, Array]] = {}
    for pair in about["pairs"]:
        names = pair["source"], pair["target"]
        result = idam.register(*(read_point_cloud(folder / name).points for name in names))
        off = rigid.log(rigid.inverse(result.transformation) @ np.array(pair["transformation"]))
        if np.linalg.norm(off[:3]) < WRONG and result.information.any():
            links[names] = result.transformation, result.covariance
            change = rigid.adjoint(result.transformation)
            links[names[::-1]] = rigid.inverse(result.transformation), change @ result.covariance @ change.T
    for a, b, c in permutations(sorted({name for names in links for name in names}), 3):
        if not (a < b < c and {(a, b), (b, c), (a, c)} <= links.keys()):
            continue
        (first, of_first), (second, of_second), (direct, of_direct) = links[a, b], links[b, c], links[a, c]
        error = rigid.log(rigid.inverse(direct) @ second @ first)
        back = rigid.adjoint(rigid.inverse(first))
        yield float(error @ np.linalg.solve(of_first + back @ of_second @ back.T + of_direct, error))


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--loops", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("| shape | points | noise | mean NEES | median | wrong |\n|---|---:|---:|---:|---:|---:|")

    def tell(shape: str, points: int | None, noise: float | None, found: list[float | None]) -> None:
        right = [x for x in found if x is not None] or [float("nan")]
        row = {"shape": shape, "points": points, "noise": noise, "nees": found}
        rows.append(row)
        cells = shape, points or "", noise or "", f"{np.mean(right):.1f}", f"{np.median(right):.1f}", found.count(None)
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)

    for name, shape in {"blob": blob, "corner": corner, "part 3": part(3), "part 7": part(7)}.items():
        for points in arguments.points:
            for noise in NOISES:
                tell(name, points, noise, repeated(shape, points, noise, arguments.repeats))
    if arguments.loops is not None:
        tell("loops of " + arguments.loops.name, None, None, list(loops(arguments.loops)))
    if arguments.json is not None:
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        arguments.json.write_text(json.dumps({"date": date, "processor": processor(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
