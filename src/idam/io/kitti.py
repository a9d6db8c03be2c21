"""KITTI's .bin, and nuScenes' .pcd.bin: float32 rows of x, y, z, intensity (and ring) without a header."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import finite_cloud
from idam.io.mesh import coordinate_type

__all__ = ["decode", "decode_nuscenes", "encode"]

FARTHEST = 1e5
"""Units past which a coordinate is taken for bytes that are none: a LiDAR sees some hundred metres."""

WIDTHS = (3, 4, 5, 6, 7)
"""Numbers a row that files of this kind have: without intensity, with ring, time, colours."""
CLEARLY = 0.7
"""How much nearer a number must be, on average, to the one so many further on than to others, to tell the width of
rows: of 40 random points whose columns are alike, the ratio varies by a tenth."""


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
    fault = InputError(f"not rows of {width} float32 numbers (x, y, z, {', '.join(names)}): check what it is")
    if len(data) % (4 * width):
        raise fault
    values = np.frombuffer(data, "<f4")
    rows = values.reshape(-1, width)
    points, intensity = rows[:, :3], rows[:, 3]
    known = points[np.isfinite(points).all(axis=1)]
    if not len(known) or np.abs(known).max() > FARTHEST or not (intensity[np.isfinite(intensity)] >= 0).all():
        raise fault
    if ((values != 0) & (np.abs(values) < np.finfo(np.float32).tiny)).any():  # whole numbers, taken for floats
        raise fault
    found = _width(values, width)
    if found != width:
        raise InputError(f"seems to hold rows of {found} float32 numbers, not {width}: save it as .npy or .ply")
    return finite_cloud(points, None, None, {name: rows[:, 3 + place] for place, name in enumerate(names)})


def _width(values: NDArray[np.float32], expected: int) -> int:
    """How many numbers a row seems to have: each is like the one so many further on, in the same column."""
    values = values[np.isfinite(values)][: 4 * 10**6]
    if len(values) < 10 * expected:
        return expected
    steps = {width: float(np.abs(values[width:] - values[:-width]).mean()) for width in WIDTHS}
    best = min(WIDTHS, key=lambda width: steps[width])
    return best if steps[best] < CLEARLY * steps[expected] else expected
