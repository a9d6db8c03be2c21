"""From any two clouds to two small, centred, scaled ones: what the network and the refinement work on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError

__all__ = ["Frame", "check_points", "choose_voxel_size", "common_frame", "downsample", "voxels", "without_strays"]

Points = NDArray[np.float64]

MIN_POINTS = 20
CORE = 0.98
"""Share of the points, those nearest to the median, that say where a cloud is and how large."""
FLATNESS = 1e-6
"""Second over first singular value of the centred cloud below which it counts as a line."""
LARGEST = 1e100
"""Coordinates past this overflow when squared and summed: as good as infinite."""
STRAY = 10.0
"""Working units from the centre past which a point is a stray: a voxel grid has no room for it."""
VOXELS = 2**20
"""Voxels that small_gicp's grid has room for on each side of the origin, along each axis."""
SMALLEST = 2.0**-12
"""Least voxel size to choose, in working units: copies of points stay one however small the voxels."""
ENOUGH = 0.96
"""Share of the points asked for with which a voxel size is good enough."""


@dataclass(frozen=True)
class Frame:
    """The coordinates the work is done in: each cloud centred on its own centre, both divided by one scale.

    Attributes:
        source_centre: in the source's frame, (3,).
        target_centre: in the target's frame, (3,).
        scale: input units in one working unit.
    """

    source_centre: Points
    target_centre: Points
    scale: float

    def source(self, points: Points) -> Points:
        """Source points (N, 3) in working coordinates."""
        return (points - self.source_centre) / self.scale

    def target(self, points: Points) -> Points:
        """Target points (N, 3) in working coordinates."""
        return (points - self.target_centre) / self.scale

    def undo(self, working: Points) -> Points:
        """A working transform (4, 4) as one from source to target in the input's coordinates."""
        rotation = working[:3, :3]
        full = np.eye(4)
        full[:3, :3] = rotation
        full[:3, 3] = self.target_centre + self.scale * working[:3, 3] - rotation @ self.source_centre
        return full

    def enter(self, full: Points) -> Points:
        """The inverse of :meth:`undo`."""
        rotation = full[:3, :3]
        working = np.eye(4)
        working[:3, :3] = rotation
        working[:3, 3] = (full[:3, 3] + rotation @ self.source_centre - self.target_centre) / self.scale
        return working


def check_points(points: Points, name: str) -> None:
    """Raise InputError unless points (N, 3) can be registered at all."""
    if len(points) < MIN_POINTS:
        raise InputError(f"{name}: has {len(points)} points, at least {MIN_POINTS} are needed; give a denser scan")
    if not np.abs(points).max() < LARGEST:  # what NaN is not, either
        count = int((~(np.abs(points) < LARGEST).all(1)).sum())
        raise InputError(f"{name}: {count} of {len(points)} points are NaN or infinite; remove them first")
    core, centre = _core(points)
    centred = core - centre
    largest = np.abs(centred).max()
    # below the rounding of the coordinates themselves, differences mean nothing
    if largest <= 1e-12 * max(1.0, float(np.abs(core).max())):
        raise InputError(f"{name}: all points are equal; nothing to register")
    centred /= largest
    spread = np.sqrt(np.clip(np.linalg.eigvalsh(centred.T @ centred), 0, None))
    if spread[1] <= FLATNESS * spread[2]:
        raise InputError(f"{name}: all points lie on a line, which leaves a rotation free; give a scan of a surface")


def common_frame(source: Points, target: Points) -> Frame:
    """Centre each cloud on the mean of its core, in float64, and scale both so that the larger fits the unit sphere.

    The core leaves out the 2 % of points farthest from the median: a scanner's (0, 0, 0) for "no return", or a few
    stray points, must not shrink everything else.
    """
    (source_core, source_centre), (target_core, target_centre) = _core(source), _core(target)
    radius = np.sqrt(max(_squares(source_core - source_centre).max(), _squares(target_core - target_centre).max()))
    return Frame(source_centre, target_centre, scale=float(radius) or 1.0)


def _core(points: Points) -> tuple[Points, Points]:
    """The points without the 2 % farthest from the median, (M, 3), and their mean, (3,)."""
    # columns in one piece and partitions: np.median and np.quantile of rows take six times as long
    middle = _ranked(np.ascontiguousarray(points.T), len(points) // 2)
    distance = _squares(points - middle)
    core = points.compress(distance <= _ranked(distance, int(CORE * (len(points) - 1))), axis=0)
    # sums of coordinates as large as UTM's would lose their last digits
    return core, middle + np.ascontiguousarray((core - middle).T).mean(1)


def _ranked(values: Points, rank: int) -> Points:
    """The value of a rank, from 0, along the last axis (..., N), (...)."""
    ranked: Points = np.partition(values, rank)[..., rank]
    return ranked


def _squares(points: Points) -> Points:
    """The squared distance (N,) of each point from the origin."""
    squares: Points = np.einsum("ij,ij->i", points, points)
    return squares


def without_strays(points: Points) -> Points:
    """Working points (N, 3) without those far from everything else."""
    return points.compress(_squares(points) < STRAY**2, axis=0)


def downsample(points: Points, voxel_size: float) -> Points:
    """The mean of the points (N, 3) in every occupied voxel, (M, 3).

    The order of the points decides the last bits of the means, and nothing else.
    """
    import small_gicp

    # one thread: with several, the library's result depends on their timing
    return np.asarray(small_gicp.voxelgrid_sampling(points, voxel_size, num_threads=1).points()[:, :3])


def voxels(points: Points, voxel_size: float) -> NDArray[np.int64]:
    """The number of the voxel that each point (N, 3) lies in, (N,): equal in one voxel, near by along the grid's rows.

    The grid is :func:`downsample`'s; what lies past its edge, a million voxels from the origin, counts to the edge.
    """
    cells = np.floor(points * (1.0 / voxel_size)).clip(-VOXELS, VOXELS - 1).astype(np.int64)
    numbers: NDArray[np.int64] = cells @ np.array([4 * VOXELS**2, 2 * VOXELS, 1])
    return numbers


def choose_voxel_size(clouds: list[Points], count: int) -> float:
    """The voxel size that leaves about ``count`` points of the largest cloud, and no more; 0 where all have fewer.

    It follows from the numbers of occupied voxels alone: the order of the points and of the clouds does not matter.
    """
    if max(map(len, clouds)) <= count:
        return 0.0
    low, high = SMALLEST, 1.0
    goal = (1 + ENOUGH) / 2 * count
    size, power = 2.0 / math.sqrt(count), 2.0  # voxels on a surface of 4 square units, and how they grow in number
    last: tuple[float, int] | None = None
    for _ in range(12):
        left = max(_distinct(voxels(points, size)) for points in clouds)
        low, high = (size, high) if left > count else (low, size)
        if ENOUGH * count <= left <= count:
            break
        if last is not None:  # curves have a lower power than surfaces, volumes a higher one
            power = min(max(math.log(left / last[1]) / math.log(last[0] / size), 0.5), 3.0)
        last = size, left
        size *= (left / goal) ** (1 / power)
        if not low < size < high:
            size = math.sqrt(low * high)
    return high


def _distinct(values: NDArray[np.int64]) -> int:
    ordered = np.sort(values)
    return int(np.count_nonzero(ordered[1:] != ordered[:-1])) + 1
