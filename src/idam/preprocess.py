"""From any two clouds to two small, centred, scaled ones: what the network and the refinement work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError

__all__ = ["Frame", "check_points", "choose_voxel_size", "common_frame", "downsample", "without_strays"]

Points = NDArray[np.float64]

MIN_POINTS = 20
FLATNESS = 1e-6
"""Second over first singular value of the centred cloud below which it counts as a line."""
LARGEST = 1e100
"""Coordinates past this overflow when squared and summed: as good as infinite."""
STRAY = 10.0
"""Working units from the centre past which a point is a stray: a voxel grid has no room for it."""


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
    finite = (np.abs(points) < LARGEST).all(1)
    if not finite.all():
        count = int((~finite).sum())
        raise InputError(f"{name}: {count} of {len(points)} points are NaN or infinite; remove them first")
    core = _core(points)
    centred = core - core.mean(0)
    largest = np.abs(centred).max()
    # below the rounding of the coordinates themselves, differences mean nothing
    if largest <= 1e-12 * max(1.0, float(np.abs(core).max())):
        raise InputError(f"{name}: all points are equal; nothing to register")
    spread = np.sqrt(np.clip(np.linalg.eigvalsh((centred / largest).T @ (centred / largest)), 0, None))
    if spread[1] <= FLATNESS * spread[2]:
        raise InputError(f"{name}: all points lie on a line, which leaves a rotation free; give a scan of a surface")


def common_frame(source: Points, target: Points) -> Frame:
    """Centre each cloud on the mean of its core, in float64, and scale both so that the larger fits the unit sphere.

    The core leaves out the 2 % of points farthest from the median: a scanner's (0, 0, 0) for "no return", or a few
    stray points, must not shrink everything else.
    """
    cores = _core(source), _core(target)
    centres = cores[0].mean(0), cores[1].mean(0)
    radii = [np.linalg.norm(core - centre, axis=1).max() for core, centre in zip(cores, centres, strict=True)]
    return Frame(centres[0], centres[1], scale=float(max(radii)) or 1.0)


def _core(points: Points) -> Points:
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near: NDArray[np.bool_] = distance <= np.quantile(distance, 0.98)
    return points[near]


def without_strays(points: Points) -> Points:
    """Working points (N, 3) without those far from everything else."""
    near: NDArray[np.bool_] = np.linalg.norm(points, axis=1) < STRAY
    return points[near]


def downsample(points: Points, voxel_size: float) -> Points:
    """The mean of the points (N, 3) in every occupied voxel, (M, 3)."""
    import small_gicp

    # one thread: with several, the library's result depends on their timing
    return np.asarray(small_gicp.voxelgrid_sampling(points, voxel_size, num_threads=1).points()[:, :3])


def choose_voxel_size(clouds: list[Points], count: int) -> float:
    """The voxel size that leaves about ``count`` points of the largest cloud; 0 where all have fewer already."""
    if max(map(len, clouds)) <= count:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(12):
        middle = (low + high) / 2
        if max(len(downsample(points, middle)) for points in clouds) > count:
            low = middle
        else:
            high = middle
    return high
