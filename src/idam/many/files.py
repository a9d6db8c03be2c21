"""What a merge leaves in its folder: poses in the formats of other tools, the graph, and one cloud."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError
from idam.io import format_transform, make_folder, rigid_fault, write_json, write_point_cloud, write_text
from idam.io.files import StrPath, one_line, read_bytes
from idam.io.quaternion import quaternion
from idam.many.result import MergeResult
from idam.rigid import Array

__all__ = ["KEPT", "read_poses", "write_merge"]

KEPT = "pairs.jsonl"
"""The file of a folder that registered pairs are kept in."""


def write_merge(folder: Path, result: MergeResult, cloud: bool = True) -> list[Path]:
    """Write the poses, the graph and the merged cloud, each file whole or not at all.

    Args:
        folder: made where it is missing.
        result: of a merge.
        cloud: whether to write the merged cloud.

    Returns:
        The files and folders written.

    Raises:
        InputError: one cannot be written.
    """
    make_folder(folder)
    remove_earlier(folder)
    transforms = make_folder(folder / "transforms")
    placed = [scan for scan in result.components[0] if result.poses[scan] is not None]
    write_json(folder / "poses.json", poses_json(result))
    order = "".join(f"# {row} {result.names[scan]}\n" for row, scan in enumerate(sorted(placed)))
    poses = [pose for scan in sorted(placed) if (pose := result.poses[scan]) is not None]
    write_text(folder / "poses.tum", f"# row, scan\n{order}" + "".join(map(tum, range(len(poses)), poses)))
    write_text(folder / "poses.kitti", "".join(map(kitti, poses)))
    write_text(folder / "poses.kitti.names", "".join(f"{result.names[scan]}\n" for scan in sorted(placed)))
    write_text(folder / "graph.g2o", g2o(result))
    for name, pose in zip(result.names, result.poses, strict=True):
        if pose is not None:
            path = transforms / f"{name}.txt"
            make_folder(path.parent)
            write_text(path, format_transform(pose) + "\n")
    names = ["poses.json", "poses.tum", "poses.kitti", "graph.g2o", "transforms"]
    if cloud and placed:
        write_point_cloud(folder / "merged.ply", result.merged())
        names.append("merged.ply")
    return [folder / name for name in names]


def remove_earlier(folder: Path) -> None:
    """Remove what an earlier run left that this one may not write: other scans' transforms, and the merged cloud."""
    try:
        names = list(read_poses(folder / "poses.json"))
    except InputError:  # there was none: what else is here is no merge's
        return
    transforms = (folder / "transforms").resolve()
    ours = [path for name in names if (path := (transforms / f"{name}.txt").resolve()).is_relative_to(transforms)]
    for old in (*ours, folder / "merged.ply"):
        with contextlib.suppress(OSError):
            old.unlink()


def read_poses(path: StrPath) -> dict[str, Array]:
    """Read poses by scan name: ``poses.json``, or an object of 4x4 matrices; scans without one are left out.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    try:
        content = json.loads(read_bytes(path))
        if not isinstance(content, dict):
            raise ValueError(f"a {type(content).__name__}, not an object")
        entries = {name: each["matrix"] if isinstance(each, dict) else each for name, each in content.items()}
        poses = {name: np.array(matrix, np.float64) for name, matrix in entries.items() if matrix is not None}
    except InputError:
        raise
    except Exception as error:  # whatever else the file may hold
        raise InputError(
            f"{path}: holds no poses ({one_line(error)}): give an object of scan name and 4x4, as poses.json"
        ) from None
    for name, matrix in poses.items():
        if fault := rigid_fault(matrix):
            raise InputError(f"{path}: the pose of {name} is not a rigid transform: {fault}")
    return poses


def poses_json(result: MergeResult) -> dict[str, Any]:
    """By scan name its pose, component, confidence and what is doubtful about it."""
    return {
        name: {
            "matrix": None if pose is None else pose.tolist(),
            "component": result.component_of(scan),
            "confidence": float(result.confidence[scan]),
            "reason": result.reason[scan],
        }
        for scan, (name, pose) in enumerate(zip(result.names, result.poses, strict=True))
    }


def tum(row: int, pose: Array) -> str:
    """A line of the TUM format, the row for the time."""
    return f"{row} {numbers(pose[:3, 3])} {xyzw(pose)}\n"


def kitti(pose: Array) -> str:
    """A line of the KITTI odometry format: the upper three rows."""
    return numbers(pose[:3].ravel()) + "\n"


def g2o(result: MergeResult) -> str:
    """The pose graph for g2o, GTSAM or Ceres: a vertex a placed scan, an edge a link that is used.

    An edge ``i j`` measures the pose of j in the frame of i: the target is i, the source is j. Its information has
    translation before rotation, the upper triangle row by row; rotation as a rotation vector, as GTSAM and Ceres take
    it.
    """
    swap = [3, 4, 5, 0, 1, 2]
    lines = [
        f"VERTEX_SE3:QUAT {scan} {numbers(pose[:3, 3])} {xyzw(pose)}"
        for scan, pose in enumerate(result.poses)
        if pose is not None
    ]
    for link in result.links:
        if link.used:
            information = link.information[np.ix_(swap, swap)][np.triu_indices(6)]
            measured = f"{numbers(link.transformation[:3, 3])} {xyzw(link.transformation)}"
            lines.append(f"EDGE_SE3:QUAT {link.target} {link.source} {measured} {numbers(information)}")
    return "\n".join(lines) + "\n"


def xyzw(pose: Array) -> str:
    """A pose's rotation as a unit quaternion, the real part last."""
    w, x, y, z = quaternion(pose[:3, :3])
    return numbers(np.array([x, y, z, w]))


def numbers(values: Array) -> str:
    """Numbers in the shortest form that reads back the same."""
    return " ".join(map(repr, (np.asarray(values, np.float64) + 0.0).tolist()))
