"""Merging many scans: ``idam.merge`` next to Open3D's multiway registration, its growth, its trust.

    python benchmarks/merge.py objects FOLDER... [--voxel-size SIZE]
    python benchmarks/merge.py views MESH... [--scans 15] [--step 24] [--points 20000] [--noise 0.002] [--poles]
    python benchmarks/merge.py rooms [--scans 60] [--points 50000] [--jobs 2]
    python benchmarks/merge.py growth [--scans 10 25 50 100 200] [--points 3000]
    python benchmarks/merge.py pairs [--scans 10 25 50 100 200] [--points 3000]
    python benchmarks/merge.py trust [--graphs 40]
    python benchmarks/merge.py plot docs/results/merge.json docs/images

Each but the last takes ``--json FILE``, where its part of the file is written anew, and ``--keep FOLDER``, where
registered pairs are kept for a run that is stopped; the time of one that goes on is not its own.

``objects``: folders of scans with a ``pairs.json``, whose pairs compose to the true poses. Each scan is turned at
random first. Open3D gets the pairs by FPFH, RANSAC and point-to-plane ICP with its voxel size set by hand, and idam's
own links too; its graph starts from the spanning tree of the best fitness, every edge is uncertain (its line process),
and its settings are those of its tutorial. ``views``: one-sided views of meshes from all around, ray-cast; with
``--poles`` one from above and one from below, too. ``rooms``: ray-cast scans from a terrestrial scanner's way through
furnished rooms. ``growth``: the same with fewer points and 4 partners, by the number of scans. ``pairs``: the same
without registering: scans that overlap by 20 % get the truth with some noise, others anything with little confidence,
which leaves all else that a merge does. Time is CPU time of all processes, memory the most that they have together.
``trust``: how often poses are right by their confidence, in made-up graphs whose links are wrong once, one and a half
times and twice as often as their confidence says. ``plot``: draws ``pairs``, and how often poses are right by their
confidence.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone
from importlib import import_module
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any
from unittest import mock
from zlib import crc32

import numpy as np

import idam
from idam import rigid
from idam.io import read_point_cloud
from idam.lab.data.graphs import FAMILIES, MadeGraph, draw_graph
from idam.lab.data.sites import Site, draw_building, draw_views
from idam.many.graph import optimise
from idam.many.loops import find_loops
from idam.many.trust import far, weigh
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
        f"{worst[1]:.3g}, median {np.median([each[0] for each in placed]):.3f} degrees, {seconds:.1f} s of CPU time",
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
    """What a call returns, and the seconds of CPU time that this process and those it ended took."""
    before = sum(os.times()[:4])
    return work(*args, **options), sum(os.times()[:4]) - before


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


# Ray-cast scans


def views(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Objects seen from places around their longest axis, so many degrees apart."""
    trimesh = import_module("trimesh")
    records = []
    count, points = (given.scans or [15])[0], given.points or 20_000
    for path in given.paths:
        mesh, rng = trimesh.load(path, process=False), np.random.default_rng(crc32(path.stem.encode()))
        axis = int(np.argmax(np.ptp(mesh.vertices, axis=0)))
        around = np.radians(given.step) * np.arange(count)
        towards = np.insert(np.stack([np.cos(around), np.sin(around)], 1), axis, rng.normal(0.1, 0.05, count), axis=1)
        for end in (1.0, -1.0) if given.poles else ():
            towards = np.concatenate([towards, np.insert(rng.normal(0, 0.4, 2), axis, end)[None]])
        site = draw_views(np.asarray(mesh.triangles), towards, points, given.noise, rng)
        radius = float(np.median([np.linalg.norm(scan - scan.mean(0), axis=1).max() for scan in site.scans]))
        records.append(merged(f"{path.stem}, {len(towards)} views", site, given, (5.0, 0.1 * radius)))
    return records


def rooms(counts: list[int], points: int, given: argparse.Namespace, partners: int | None) -> list[dict[str, Any]]:
    """A building, by the number of scans."""
    sites = ((count, draw_building(count, points, np.random.default_rng(count))) for count in counts)
    return [merged(f"{count} scans of {points} points", site, given, (2.0, 0.2), partners) for count, site in sites]


def registered_by_truth(counts: list[int], points: int, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Growth of all but the registrations."""
    records = []
    given.jobs, given.keep = 1, None
    for count in counts:
        site = draw_building(count, points, np.random.default_rng(count))
        told = Told(site)
        with mock.patch("idam.many.pairs.Register", lambda _, told=told: told):
            records.append(merged(f"{count} scans, not registered", site, given, (2.0, 0.2), 4))
    return records


class Told:
    """Takes the place of registering: the truth where scans overlap."""

    def __init__(self, site: Site):
        small_gicp = import_module("small_gicp")
        self._poses = site.poses
        placed = [rigid.apply(pose, scan) for pose, scan in zip(site.poses, site.scans, strict=True)]
        self._points, self._trees = [each[::20] for each in placed], [small_gicp.KdTree(each) for each in placed]

    def __call__(self, task: tuple[tuple[int, int], dict[str, Any]]) -> dict[str, Any]:
        """A row as of a registered pair."""
        source, target = task[0]
        rng = np.random.default_rng(task[0])
        near = self._trees[target].batch_knn_search(self._points[source], 1)[1][:, 0] < 0.25**2
        right = near.mean() > 0.2
        truth = rigid.inverse(self._poses[target]) @ self._poses[source]
        off = rigid.exp(rng.normal(scale=0.0005 if right else 2.0, size=6))
        return {
            "error": "",
            "transformation": (truth @ off).tolist(),
            "information": (np.eye(6) / 0.0005**2).tolist(),
            "confidence": 0.97 if right else 0.1,
            "reason": "",
            "overlap": float(near.mean()),
            "residual": 0.01,
            "reach": 0.1,
        }


def merged(
    name: str, site: Site, given: argparse.Namespace, right: tuple[float, float], partners: int | None = None
) -> dict[str, Any]:
    """What a table says of a merge; each component's poses are compared with the truth from its own first scan."""
    started = time.perf_counter()
    kept = given.keep and given.keep / f"{name}.jsonl"
    gone_on = bool(kept and kept.exists())
    with Memory() as memory:
        result, cpu = timed(idam.merge, site.scans, jobs=given.jobs, partners=partners, keep=kept)
    seconds = time.perf_counter() - started
    good = np.zeros(len(site.scans), bool)
    for scans in result.components:
        inside = set(scans)
        off = site.errors([pose if i in inside else None for i, pose in enumerate(result.poses)], scans[0])
        good |= (off[:, 0] <= right[0]) & (off[:, 1] <= right[1])
    largest, sure = result.components[0], result.confidence >= 0.9
    off = site.errors([pose if i in set(largest) else None for i, pose in enumerate(result.poses)], largest[0])[largest]
    record = {
        "name": name,
        "scans": len(site.scans),
        "points": round(float(np.mean([len(scan) for scan in site.scans]))),
        "pairs": len(result.links),
        "components": [len(scans) for scans in result.components],
        "right_in_largest": int(good[largest].sum()),
        "sure": int(sure.sum()),
        "sure_and_wrong": int((sure & ~good).sum()),
        "worst": off.max(0).tolist(),
        "median": np.median(off, axis=0).tolist(),
        "cpu": None if gone_on else cpu,
        "seconds": None if gone_on else seconds,
        "memory": None if gone_on else memory.most / 2**30,
        "confidence": [float(result.confidence[i]) for scans in result.components for i in scans[1:]],
        "right": [bool(good[i]) for scans in result.components for i in scans[1:]],
    }
    print(json.dumps({key: value for key, value in record.items() if not isinstance(value, list)}), flush=True)
    return record


class Memory:
    """The most memory that this process and those it started have together, looked at every second."""

    def __enter__(self) -> Memory:
        self.most, self._done = 0, threading.Event()
        self._watch = threading.Thread(target=self._look)
        self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._watch.join()

    def _look(self) -> None:
        psutil = import_module("psutil")
        own = psutil.Process()
        while not self._done.wait(1.0):
            with contextlib.suppress(psutil.Error):
                everyone = [own, *own.children(recursive=True)]
                self.most = max(self.most, sum(process.memory_info().rss for process in everyone))


# Trust


def trust(graphs: int) -> list[dict[str, Any]]:
    """How often poses are right, by their confidence, over so many graphs of each family."""
    records = []
    for trusting in (1.0, 1.5, 2.0):
        for family in FAMILIES:
            found = []
            for number in range(graphs):
                graph = draw_graph(np.random.default_rng([5, number]), family, trusting)
                found += judged(graph)
            confidence, right = np.array(found, float).reshape(-1, 2).T
            sure = confidence >= 0.9
            print(
                f"{trusting:.1f} {family:<10} {sure.sum():5d} sure, {right[sure].mean():.4f} of them right", flush=True
            )
            records.append(
                {"trusting": trusting, "family": family, "confidence": confidence.tolist(), "right": right.tolist()}
            )
    return records


def judged(graph: MadeGraph) -> list[tuple[float, bool]]:
    """The confidence of each scan, and whether its pose is right relative to its component's first scan."""
    count = len(graph.poses)
    poses, agrees = optimise(count, graph.links, find_loops(count, graph.links).closed(len(graph.links)))
    known = weigh(poses, graph.links, agrees, [str(scan) for scan in range(count)], 0.9)
    found = []
    for first, *others in known.components:
        for scan in others:
            expected, actual = (rigid.inverse(each[first]) @ each[scan] for each in (graph.poses, poses))
            found.append((float(known.confidence[scan]), not far(rigid.log(rigid.inverse(expected) @ actual))))
    return found


EDGES = (0.1, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.001)
"""Of the confidences that are counted together."""


def plot(results: Path, images: Path) -> None:
    """Draw growth and trust."""
    pyplot = import_module("matplotlib.pyplot")
    parts = json.loads(results.read_text())
    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    records = parts["pairs"]["records"]
    scans = [record["scans"] for record in records]
    for place, key, label in (
        (axes[0], "pairs", "pairs registered"),
        (axes[1], "cpu", "CPU time without registering (s)"),
    ):
        values = [record[key] for record in records]
        place.plot(scans, values, "o-", color="#1f6f8b")
        slope = np.dot(scans, values) / np.dot(scans, scans)
        place.plot([0, scans[-1]], [0, slope * scans[-1]], ":", color="#888888", label=f"{slope:.2g} a scan")
        place.set(xlabel="scans", ylabel=label, xlim=0, ylim=0)
        place.legend(frameon=False)
    figure.savefig(images / "merge-growth.png", dpi=110)
    figure, place = pyplot.subplots(figsize=(4.6, 4), layout="constrained")
    for trusting, color in ((1.0, "#1f6f8b"), (1.5, "#d08c2f"), (2.0, "#b0413e")):
        own = [record for record in parts["trust"]["records"] if record["trusting"] == trusting]
        bins = [found for *_, found in calibration(own) if found["scans"] > 20]
        said, was = ([found[key] for found in bins] for key in ("said", "right"))
        place.plot(said, was, "o-", color=color, label=f"links wrong {trusting:g} times as often as they say")
    place.plot([0.5, 1], [0.5, 1], ":", color="#888888")
    place.set(xlabel="confidence of a scan", ylabel="share that is right")
    place.legend(frameon=False, fontsize=8)
    figure.savefig(images / "merge-trust.png", dpi=110)


def calibration(records: list[dict[str, Any]]) -> list[tuple[float, float, dict[str, float]]]:
    """How often scans are right, by their confidence (from, to), over all records that say so of each."""
    confidence, right = (np.concatenate([record[key] for record in records]) for key in ("confidence", "right"))
    bins = [(low, high, (confidence >= low) & (confidence < high)) for low, high in pairwise(EDGES)]
    return [
        (low, high, {"scans": len(right[own]), "said": confidence[own].mean(), "right": right[own].mean()})
        for low, high, own in bins
        if own.any()
    ]


def main() -> None:
    """Measure, print, and write with --json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["objects", "views", "rooms", "growth", "pairs", "trust", "plot"])
    parser.add_argument("paths", type=Path, nargs="*")
    parser.add_argument("--voxel-size", type=float, default=0.003, help="of Open3D, set by hand")
    parser.add_argument("--scans", type=int, nargs="+")
    parser.add_argument("--step", type=float, default=24.0, help="degrees between views")
    parser.add_argument("--noise", type=float, default=0.002, help="of views, as a share of the radius")
    parser.add_argument("--poles", action="store_true", help="views from above and below, too")
    parser.add_argument("--points", type=int)
    parser.add_argument("--graphs", type=int, default=40)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder of registered pairs")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.what == "plot":
        plot(*given.paths)
        return
    if given.what == "objects":
        records = objects(given.paths, given.voxel_size, given.jobs)
    elif given.what == "views":
        records = views(given)
    elif given.what == "rooms":
        records = rooms(given.scans or [60], given.points or 50_000, given, None)
    elif given.what == "growth":
        records = rooms(given.scans or [10, 25, 50, 100, 200], given.points or 3000, given, 4)
    elif given.what == "pairs":
        records = registered_by_truth(given.scans or [10, 25, 50, 100, 200], given.points or 3000, given)
    else:
        records = trust(given.graphs)
    if given.json is not None:
        parts = json.loads(given.json.read_text()) if given.json.exists() else {}
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        command = f"benchmarks/merge.py {given.what}"
        parts[given.what] = {"command": command, "date": date, "idam": idam.__version__, "records": records}
        given.json.write_text(json.dumps(parts, indent=1) + "\n")


if __name__ == "__main__":
    main()
