"""Merging many scans: ``idam.merge`` next to Open3D's multiway registration, and its time by the number of scans.

    python benchmarks/merge.py objects FOLDER... [--voxel-size SIZE] [--json FILE]
    python benchmarks/merge.py rooms [--scans 60] [--points 50000] [--jobs 2] [--json FILE]
    python benchmarks/merge.py growth [--scans 10 30 60 100 200] [--points 5000] [--json FILE]

``objects``: folders of scans with a ``pairs.json``, whose pairs compose to the true poses. Each scan is turned at
random first. Open3D gets the pairs by FPFH, RANSAC and point-to-plane ICP with its voxel size set by hand, and idam's
own links too; its graph starts from the spanning tree of the best fitness, every edge is uncertain (its line process),
and its settings are those of its tutorial. ``rooms``: scans by a made-up scanner on its way through made-up rooms.
``growth``: the same with fewer points, by the number of scans.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from datetime import datetime, timezone
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import idam
from idam import rigid
from idam.io import read_point_cloud
from idam.rigid import Array

RIGHT = (2.0, 0.002)
"""Degrees and metres within which a scan of the bunny's kind counts as placed right."""


def truth_of(folder: Path) -> tuple[list[str], Array]:
    """The scans of a folder that its pairs join, and their poses to the first one's frame."""
    pairs = json.loads((folder / "pairs.json").read_text())["pairs"]
    poses: dict[str, Array] = {pairs[0]["target"]: np.eye(4)}
    while True:
        before = len(poses)
        for pair in pairs:
            matrix = np.array(pair["transformation"])
            step = rigid.transform(rigid.nearest_rotation(matrix[:3, :3]), matrix[:3, 3])
            if pair["target"] in poses:
                poses.setdefault(pair["source"], poses[pair["target"]] @ step)
            elif pair["source"] in poses:
                poses[pair["target"]] = poses[pair["source"]] @ rigid.inverse(step)
        if len(poses) == before:
            return sorted(poses), np.stack([poses[name] for name in sorted(poses)])


def errors(clouds: list[Array], truth: Array, poses: list[Array | None]) -> list[tuple[float, float] | None]:
    """Degrees, and shift of the centroid, by which each placed scan is off once the first placed one is aligned."""
    first = next(i for i, pose in enumerate(poses) if pose is not None)
    found: list[tuple[float, float] | None] = []
    for cloud, true, pose in zip(clouds, truth, poses, strict=True):
        if pose is None:
            found.append(None)
            continue
        anchor = poses[first]
        assert anchor is not None
        expected, actual = rigid.inverse(truth[first]) @ true, rigid.inverse(anchor) @ pose
        centre = cloud.mean(0)[None]
        shift = float(np.linalg.norm(rigid.apply(expected, centre) - rigid.apply(actual, centre)))
        found.append((float(np.degrees(rigid.angle(rigid.inverse(expected) @ actual))), shift))
    return found


def summary(
    name: str, off: list[tuple[float, float] | None], seconds: float, right: tuple[float, float]
) -> dict[str, Any]:
    """What a table says of a method."""
    placed = [each for each in off if each is not None]
    good = sum(degrees <= right[0] and shift <= right[1] for degrees, shift in placed)
    worst = [max(each[axis] for each in placed) for axis in (0, 1)]
    print(
        f"{name:<40} placed {len(placed)} of {len(off)}, right {good}, worst {worst[0]:.3f} degrees and "
        f"{worst[1]:.3g}, median {np.median([each[0] for each in placed]):.3f} degrees, {seconds:.1f} s",
        flush=True,
    )
    return {"method": name, "errors": off, "right": good, "seconds": seconds}


# Open3D's multiway registration


def open3d_pairs(clouds: list[Array], voxel: float) -> tuple[list[Any], dict[tuple[int, int], tuple[Array, float]]]:
    """Thinned clouds, and each pair by FPFH, RANSAC and point-to-plane ICP: the transform and its fitness."""
    o3d = import_module("open3d")
    registration = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    thinned, features = [], []
    for points in clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        thinned.append(cloud)
        features.append(registration.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)))
    pairs = {}
    for source, target in combinations(range(len(clouds)), 2):
        distance = 1.5 * voxel
        coarse = registration.registration_ransac_based_on_feature_matching(
            thinned[source],
            thinned[target],
            features[source],
            features[target],
            True,
            distance,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(distance),
            ],
            registration.RANSACConvergenceCriteria(100000, 0.999),
        )
        fine = registration.registration_icp(
            thinned[source],
            thinned[target],
            distance,
            coarse.transformation,
            registration.TransformationEstimationPointToPlane(),
        )
        pairs[source, target] = np.array(fine.transformation), float(fine.fitness)
    return thinned, pairs


def open3d_graph(
    thinned: list[Any], pairs: dict[tuple[int, int], tuple[Array, float]], voxel: float
) -> list[Array | None]:
    """Poses by Open3D's global optimisation with its line process."""
    o3d = import_module("open3d")
    registration = o3d.pipelines.registration
    order = sorted(pairs, key=lambda pair: -pairs[pair][1])
    poses: dict[int, Array] = {0: np.eye(4)}
    while len(poses) < len(thinned):
        source, target = next(pair for pair in order if (pair[0] in poses) != (pair[1] in poses))
        matrix = pairs[source, target][0]
        if target in poses:
            poses[source] = poses[target] @ matrix
        else:
            poses[target] = poses[source] @ np.linalg.inv(matrix)
    graph = registration.PoseGraph()
    for scan in range(len(thinned)):
        graph.nodes.append(registration.PoseGraphNode(poses[scan]))
    for (source, target), (matrix, _) in pairs.items():
        information = registration.get_information_matrix_from_point_clouds(
            thinned[source], thinned[target], 1.5 * voxel, matrix
        )
        graph.edges.append(registration.PoseGraphEdge(source, target, matrix, information, uncertain=True))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(1.5 * voxel, 0.25, 1.0, 0),
    )
    return [np.array(node.pose) for node in graph.nodes]


def timed(work: Callable[..., Any], *args: Any, **options: Any) -> tuple[Any, float]:
    """What a call returns, and the seconds it took."""
    started = time.perf_counter()
    return work(*args, **options), time.perf_counter() - started


def objects(folders: list[Path], voxel: float, jobs: int) -> list[dict[str, Any]]:
    """Side by side on real scans."""
    records = []
    for folder in folders:
        names, truth = truth_of(folder)
        random = np.random.default_rng(0)
        turns = rigid.exp(random.normal(scale=[1.5] * 3 + [0.1] * 3, size=(len(names), 6)))
        clouds = [
            rigid.apply(turn, read_point_cloud(folder / name).points) for turn, name in zip(turns, names, strict=True)
        ]
        truth = truth @ rigid.inverse(turns)

        result, seconds = timed(idam.merge, clouds, jobs=jobs)
        found = [summary("idam.merge", errors(clouds, truth, result.poses), seconds, RIGHT)]
        sure = [pose if result.confidence[i] >= 0.9 else None for i, pose in enumerate(result.poses)]
        found.append(summary("idam.merge, sure scans", errors(clouds, truth, sure), seconds, RIGHT))
        (thinned, pairs), paired = timed(open3d_pairs, clouds, voxel)
        poses, solved = timed(open3d_graph, thinned, pairs, voxel)
        found.append(summary("Open3D on FPFH + RANSAC + ICP", errors(clouds, truth, poses), paired + solved, RIGHT))
        ours = {(link.source, link.target): (link.transformation, link.overlap) for link in result.links}
        poses, solved = timed(open3d_graph, thinned, ours, voxel)
        found.append(summary("Open3D's graph on idam's links", errors(clouds, truth, poses), solved, RIGHT))
        records += [{"set": folder.name, **record} for record in found]
    return records


# Made-up rooms


def rooms(count: int, points: int, seed: int = 0) -> tuple[list[Array], Array]:
    """Scans from a path through a building of furnished rooms, and their poses.

    The building is made of boxes; each scan sees what lies within eight metres, turned about the vertical and a little
    tilted.
    """
    random = np.random.default_rng(seed)
    length = 2.0 * count
    boxes = [((0.0, -4.0, -0.1), (length, 4.0, 0.0))]  # the floor
    for wall in np.arange(0.0, length + 6, 6.0):
        boxes.append(((wall, -4.0, 0.0), (wall + 0.2, random.uniform(-1.5, 1.0), 2.8)))
    for side in (-4.0, 4.0):
        boxes.append(((0.0, side - 0.1, 0.0), (length, side + 0.1, 2.8)))
    for _ in range(3 * count):  # furniture
        low = random.uniform([0, -3.7, 0], [length, 3.2, 0.02])
        boxes.append((tuple(low), tuple(low + random.uniform([0.2, 0.2, 0.3], [1.6, 1.2, 2.2]))))
    cloud = np.concatenate([box_surface(np.array(low), np.array(high), random) for low, high in boxes])
    scans, poses = [], []
    for scan in range(count):
        place = np.array([1.0 + 2.0 * scan * (length - 2) / length, random.uniform(-0.5, 0.5), 1.5])
        near = cloud[np.linalg.norm(cloud - place, axis=1) < 8.0]
        chosen = near[random.choice(len(near), min(points, len(near)), replace=False)]
        turn = [*random.normal(scale=0.1, size=2), random.uniform(-np.pi, np.pi)]
        pose = rigid.transform(rigid.rotation_exp(np.array(turn)), place)
        noisy = chosen + random.normal(scale=0.005, size=chosen.shape)
        scans.append(rigid.apply(rigid.inverse(pose), noisy))
        poses.append(pose)
    return scans, np.stack(poses)


def box_surface(low: Array, high: Array, random: np.random.Generator, density: float = 400.0) -> Array:
    """Random points on the faces of a box, so many to the square metre."""
    size = high - low
    faces = []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        number = max(8, int(density * size[others[0]] * size[others[1]]))
        for end in (low, high):
            face = random.uniform(low, high, (number, 3))
            face[:, axis] = end[axis]
            faces.append(face)
    return np.concatenate(faces)


def scenes(counts: list[int], points: int, jobs: int) -> list[dict[str, Any]]:
    """Time, memory and errors by the number of scans."""
    records = []
    for count in counts:
        clouds, truth = rooms(count, points)
        started, before = time.perf_counter(), os.times()
        result = idam.merge(clouds, jobs=jobs)
        seconds, after = time.perf_counter() - started, os.times()
        cpu = sum(after[:4]) - sum(before[:4])
        memory = [resource.getrusage(who).ru_maxrss / 2**20 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        largest = set(result.components[0])
        off = errors(clouds, truth, [pose if i in largest else None for i, pose in enumerate(result.poses)])
        record = summary(f"{count} scans of {points} points", off, seconds, (2.0, 0.1))
        record |= {"scans": count, "points": points, "pairs": len(result.links), "cpu": cpu, "memory": memory}
        print(f"    {len(result.links)} pairs, {cpu:.1f} s of CPU, {memory[0]:.2f} GB and {memory[1]:.2f} GB a process")
        records.append(record)
    return records


def main() -> None:
    """Measure, print, and write with --json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["objects", "rooms", "growth"])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--voxel-size", type=float, default=0.003, help="of Open3D, set by hand")
    parser.add_argument("--scans", type=int, nargs="+")
    parser.add_argument("--points", type=int)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "objects":
        records = objects(arguments.folders, arguments.voxel_size, arguments.jobs)
    elif arguments.what == "rooms":
        records = scenes(arguments.scans or [60], arguments.points or 50_000, arguments.jobs)
    else:
        records = scenes(arguments.scans or [10, 30, 60, 100, 200], arguments.points or 5000, arguments.jobs)
    if arguments.json is not None:
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        arguments.json.write_text(json.dumps({"date": date, "idam": idam.__version__, "records": records}, indent=1))


if __name__ == "__main__":
    main()
