"""Voxel grids on one ladder of sizes, so that a cloud's levels serve every pair it is in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from idam.rigid import Array

__all__ = ["STEPS", "downsample", "ladder", "occupied", "rung", "rung_for"]

STEPS = 4
"""Rungs to a factor of two in length: one rung changes the number of voxels on a surface by 1.4."""
VOXELS = 2**20
"""Voxels that small_gicp's grid has room for on each side of the origin, along each axis."""
ENOUGH = 0.68
"""Share of the number asked for with which a rung is good enough: somewhat less than what one rung changes."""


def ladder(rung: int) -> float:
    """The length of a rung, 2^(rung / 4)."""
    return float(2.0 ** (rung / STEPS))


def rung(length: float) -> int:
    """The rung nearest to a positive length."""
    return round(STEPS * math.log2(length))


def downsample(points: Array, voxel_size: float) -> Array:
    """The mean of the points (N, 3) in every occupied voxel, (M, 3).

    The order of the points decides the last bits of the means, and nothing else.
    """
    import small_gicp

    # the library counts the fourth coordinate, 1, in voxels, too: below a millionth there is no room for it
    unit = 2.0 ** math.floor(math.log2(voxel_size))
    # one thread: with several, the library's result depends on their timing
    means = small_gicp.voxelgrid_sampling(points / unit, voxel_size / unit, num_threads=1).points()[:, :3]
    return np.ascontiguousarray(means * unit)


def occupied(points: Array, voxel_size: float) -> int:
    """How many voxels of :func:`downsample`'s grid hold points (N, 3)."""
    ordered = np.sort(_keys(points, voxel_size))
    return int(np.count_nonzero(ordered[1:] != ordered[:-1])) + 1


def rung_for(points: Array, count: int, extent: float) -> int | None:
    """The rung of the voxel size that leaves at most ``count`` of the points (N, 3), and not many less.

    It follows from the numbers of occupied voxels alone: the order of the points does not matter.

    Args:
        points: about the origin.
        count: points to leave at most.
        extent: radius of the cloud: voxels are not chosen larger.

    Returns:
        None where there are no more points than that to begin with.
    """
    if len(points) <= count:
        return None
    high = rung(2 * extent)  # leaves eight at most
    low = high - STEPS * 12  # copies of points stay one however small the voxels
    at, power = rung(2 * extent / math.sqrt(count)), 2.0
    last: tuple[int, int] | None = None
    while low < high:
        at = min(max(at, low), high - 1)
        left = occupied(points, ladder(at))
        if left > count:
            low = at + 1
        else:
            high = at
            if left >= ENOUGH * count:
                break
        if last is not None and last[0] != at:  # curves have a lower power than surfaces, volumes a higher one
            power = min(max(STEPS * math.log2(last[1] / left) / (at - last[0]), 0.5), 3.0)
        last = at, left
        at += round(STEPS / power * math.log2(left / (0.84 * count))) or (1 if left > count else -1)
    return high


def _keys(points: Array, voxel_size: float) -> NDArray[np.int64]:
    """The number of the voxel that each point (N, 3) lies in, (N,); what lies past the grid's edge counts to it."""
    cells = np.floor(points * (1.0 / voxel_size)).clip(-VOXELS, VOXELS - 1).astype(np.int64)
    numbers: NDArray[np.int64] = cells @ np.array([4 * VOXELS**2, 2 * VOXELS, 1])
    return numbers
