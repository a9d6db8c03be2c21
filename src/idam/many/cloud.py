"""Many clouds in one frame made one, in which each place is there once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from idam.errors import InputError
from idam.io import PointCloud
from idam.rigid import Array

__all__ = ["fuse"]


def fuse(clouds: Sequence[PointCloud], voxel_size: float, numbers: Sequence[int]) -> PointCloud:
    """One point for each voxel that the clouds occupy: the mean of the points in it, of their colours and normals.

    Args:
        clouds: in one frame; at least one.
        voxel_size: in their units.
        numbers: of the clouds.

    Returns:
        Points in the order of their voxels, with the number of the cloud that each voxel's first point is from as the
        attribute ``scan``. Colours and normals where every cloud has them: others would have to be made up.

    Raises:
        InputError: there is no cloud, or the voxel size is no length, or too small for the voxels to be numbered.
    """
    if not clouds:
        raise InputError("no scan has a pose: there is nothing to make one cloud of")
    if not 0 < voxel_size < np.inf:
        raise InputError(f"voxel_size must be a positive number, not {voxel_size!r}")
    points = np.concatenate([cloud.points for cloud in clouds])
    low = points.min(0)
    cells = np.floor((points - low) / voxel_size)
    sides = cells.max(0) + 1
    if sides.prod() > 2**62:
        raise InputError(f"a voxel size of {voxel_size:g} is too small for clouds this large: give a larger one")
    cell = cells.astype(np.int64) @ np.array([sides[1] * sides[2], sides[2], 1]).astype(np.int64)
    order = np.argsort(cell, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0])
    counts = np.diff(np.r_[starts, len(order)])[:, None]

    def mean(rows: Array) -> Array:
        return np.asarray(np.add.reduceat(rows[order], starts) / counts)

    colors = normals = None
    if all(cloud.colors is not None for cloud in clouds):
        shades = np.concatenate([cloud.colors for cloud in clouds if cloud.colors is not None]).astype(np.float64)
        colors = np.rint(mean(shades)).astype(np.uint8)
    if all(cloud.normals is not None for cloud in clouds):
        normals = mean(np.concatenate([cloud.normals for cloud in clouds if cloud.normals is not None]))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(length > 0, length, 1.0)
    scan = np.repeat(np.array(numbers, np.int32), [len(cloud.points) for cloud in clouds])
    return PointCloud(mean(points - low) + low, colors, normals, {"scan": scan[order][starts]})
