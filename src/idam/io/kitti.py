"""KITTI's .bin, and nuScenes' .pcd.bin: float32 rows of x, y, z, intensity (and ring) without a header."""

from __future__ import annotations

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import finite_cloud
from idam.io.mesh import coordinate_type

__all__ = ["decode", "decode_nuscenes", "encode"]

FARTHEST = 1e5
"""Units past which a coordinate is taken for bytes that are none: a LiDAR sees some hundred metres."""


def decode(data: bytes) -> PointCloud:
    """Read rows of x, y, z, intensity.

    Raises:
        InputError: the bytes are not such rows.
    """
    return _decode(data, ("intensity",))


def decode_nuscenes(data: bytes) -> PointCloud:
    """Read rows of x, y, z, intensity, ring.

    Raises:
        InputError: the bytes are not such rows.
    """
    return _decode(data, ("intensity", "ring"))


def encode(cloud: PointCloud) -> bytes:
    """Encode rows of x, y, z, intensity (0 if unknown).

    Raises:
        InputError: float32 would round the coordinates by more than a millionth of the cloud's extent.
    """
    if coordinate_type(cloud.points) != "f4":
        raise InputError("is too far from the origin for the float32 numbers of .bin: write .ply or .laz")
    intensity = cloud.attributes.get("intensity", np.zeros(len(cloud.points)))
    return np.column_stack([cloud.points, intensity]).astype("<f4").tobytes()


def _decode(data: bytes, names: tuple[str, ...]) -> PointCloud:
    width = 3 + len(names)
    if len(data) % (4 * width):
        raise InputError(f"not rows of {width} float32 numbers (x, y, z, {', '.join(names)}): check what it is")
    rows = np.frombuffer(data, "<f4").reshape(-1, width)
    points, intensity = rows[:, :3], rows[:, 3]
    known = points[np.isfinite(points).all(axis=1)]
    if not len(known) or np.abs(known).max() > FARTHEST or not (intensity[np.isfinite(intensity)] >= 0).all():
        raise InputError(f"not rows of {width} float32 numbers (x, y, z, {', '.join(names)}): check what it is")
    return finite_cloud(points, None, None, {name: rows[:, 3 + place] for place, name in enumerate(names)})
