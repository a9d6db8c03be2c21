"""Real scans: how many pairs ``idam.register`` gets right with no option set, next to rivals with a voxel size set.

    python benchmarks/scans.py FOLDER... [--voxel-size NAME=SIZE ...] [--json FILE]

Each folder holds scans and a ``pairs.json``: ``pairs`` of ``name``, ``source``, ``target``, ``transformation`` (4x4,
target = T source) and ``overlap``, and what counts as ``success``: ``rotation_deg``, and ``centroid_shift`` of the
source's centroid. The rivals' voxel size is set by hand for each folder; their other settings follow from it as their
authors advise, and Open3D's point-to-plane ICP comes after each. Every pair is registered by every method in turn. The
row of prepared clouds is the same registration of clouds that :func:`idam.prepare` made ready, which is not timed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import idam
from idam.clouds.prepared import Prepared
from idam.io import read_point_cloud
from idam.lab.evaluation.methods import build_method
from idam.lab.evaluation.metrics import motion_error
from idam.lab.evaluation.record import processor
from idam.search.judge import CONVERGED

Points = NDArray[np.float64]
Register = Callable[[Points, Points], tuple[Points, float | None]]

VOXEL_SIZES = {"bunny": 0.003, "indoor": 0.05, "street": 0.4, "lidar": 0.4, "car": 0.2}
"""Set by hand for the rivals, in the scans' unit."""
PREPARED = "idam, prepared clouds"
BANDS = {"0.5 and more": (0.5, 1.01), "0.3 to 0.5": (0.3, 0.5), "below 0.3": (0.0, 0.3)}


def rival(name: str, voxel: float) -> Register:
    """A method of the tables on clouds of one voxel size, and ICP after it."""
    o3d = import_module("open3d")
    registration = o3d.pipelines.registration
    settings = {
        "fpfh-ransac": ["normal_radius=2", "feature_radius=5", "ransac_distance=1.5", "ransac_edges=0.9"],
        "fgr": ["normal_radius=2", "feature_radius=5", "fgr_distance=0.5"],
        "kiss-matcher": ["voxel_size=1"],
    }[name]
    method = build_method(name, settings=settings)

    def register(source: Points, target: Points) -> tuple[Points, None]:
        clouds = [
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
            for points in (source, target)
        ]
        # in voxels, since KISS-Matcher takes none of millimetres; and near the origin, for float32's sake
        centres = [np.asarray(cloud.points).mean(0) for cloud in clouds]
        small = [
            ((np.asarray(cloud.points) - centre) / voxel).astype(np.float32)
            for cloud, centre in zip(clouds, centres, strict=True)
        ]
        start = method(*small)
        start[:3, 3] = voxel * start[:3, 3] + centres[1] - start[:3, :3] @ centres[0]
        clouds[1].estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        plane = registration.TransformationEstimationPointToPlane()
        return np.array(registration.registration_icp(*clouds, 1.5 * voxel, start, plane).transformation), None

    return register


def ours(source: Points | Prepared, target: Points | Prepared) -> tuple[Points, float]:
    """``idam.register``, and its confidence."""
    result = idam.register(source, target)
    return result.transformation, result.confidence


def is_right(estimate: Points, truth: Points, centroid: Points, success: dict[str, float]) -> bool:
    """Whether a transform is within the success limits."""
    degrees, shift = motion_error(estimate, truth, centroid)
    return degrees <= success["rotation_deg"] and shift <= success["centroid_shift"]


def run(folder: Path, voxel: float) -> list[dict[str, Any]]:
    """One record for each pair and method."""
    methods: dict[str, Register] = {"idam": ours, PREPARED: ours}
    methods |= {f"{name}+icp": rival(name, voxel) for name in ("fpfh-ransac", "fgr", "kiss-matcher")}
    about = json.loads((folder / "pairs.json").read_text())
    records = []
    for pair in about["pairs"]:
        source, target = (read_point_cloud(folder / pair[side]).points for side in ("source", "target"))
        for name, method in methods.items():
            given = (idam.prepare(source), idam.prepare(target)) if name == PREPARED else (source, target)
            started, worked = time.perf_counter(), time.process_time()
            estimate, confidence = method(*given)
            seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - worked
            right = is_right(estimate, np.array(pair["transformation"]), source.mean(0), about["success"])
            records.append(
                {
                    "set": folder.name,
                    "pair": pair["name"],
                    "overlap": pair["overlap"],
                    "method": name,
                    "right": right,
                    "seconds": seconds,
                    "cpu_seconds": cpu_seconds,
                    "confidence": confidence,
                }
            )
        print(pair["name"], {r["method"]: r["right"] for r in records[-len(methods) :]}, flush=True)
    return records


def table(records: list[dict[str, Any]]) -> str:
    """Pairs that are right, and of these accepted where the method says so, by set and by overlap; and times."""
    groups = {name: [r for r in records if r["set"] == name] for name in dict.fromkeys(r["set"] for r in records)}
    for band, (low, high) in BANDS.items():
        groups[f"overlap {band}"] = [r for r in records if low <= r["overlap"] < high]
    groups["all"] = records
    times = ["median s", "mean s", "median CPU s", "mean CPU s"]
    lines = [f"| | {' | '.join([*groups, *times])} |", "|---" * (len(groups) + len(times) + 1) + "|"]
    for name in dict.fromkeys(r["method"] for r in records):
        counts = " | ".join(count([r for r in group if r["method"] == name]) for group in groups.values())
        spent = np.array([(r["seconds"], r["cpu_seconds"]) for r in records if r["method"] == name])
        taken = [f(column) for column in spent.T for f in (np.median, np.mean)]
        lines.append(f"| {name} | {counts} | {' | '.join(f'{value:.2f}' for value in taken)} |")
    return "\n".join(lines)


def count(records: list[dict[str, Any]]) -> str:
    """Right, and of these accepted: ``41 / 37 of 42``; or right alone, of methods without a confidence."""
    right = [r for r in records if r["right"]]
    if any(r["confidence"] is None for r in records):
        return f"{len(right)} of {len(records)}"
    return f"{len(right)} / {sum(r['confidence'] >= CONVERGED for r in right)} of {len(records)}"


def claim(records: list[dict[str, Any]]) -> str:
    """How many of the confident answers are right."""
    sure = [r["right"] for r in records if r["method"] == "idam" and r["confidence"] >= 0.9]
    return f"Right / accepted, of pairs. Of {len(sure)} answers of confidence 0.9 and more, {sum(sure)} are right."


def main() -> None:
    """Measure, print, and write with --json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--voxel-size", nargs="+", default=[], metavar="NAME=SIZE", help="of the rivals, by folder")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    voxels = VOXEL_SIZES | {name: float(size) for name, size in (text.split("=") for text in arguments.voxel_size)}
    records = [record for folder in arguments.folders for record in run(folder, voxels[folder.name])]
    print(f"{table(records)}\n\n{claim(records)}")
    if arguments.json is not None:
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        about = {"date": date, "processor": processor(), "idam": idam.__version__}
        arguments.json.write_text(json.dumps({**about, "records": records}, indent=1))


if __name__ == "__main__":
    main()
