"""Two clouds at several resolutions, each for one purpose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from idam.align import Refinable, Surfaces
from idam.clouds.frame import MIN_POINTS, choose_voxel_size, downsample
from idam.errors import InputError

__all__ = ["Level", "Pyramid", "build_pyramid", "level", "spacing_of"]

Points = NDArray[np.float64]

NETWORK_POINTS = 1024
"""Points of the larger cloud that the network sees: what it was trained on."""
MATCHING_POINTS = 2000
"""Points of the larger cloud that features are matched on."""
MOST_POINTS = 4096
"""Points of either cloud at most that features are matched on, where the caller chooses the voxel size."""
FINE_POINTS = 10_000
"""Points of the larger cloud that the last refinement uses."""
SAMPLE = 1000
"""Points at least whose nearest neighbours tell the spacing of a cloud."""
FINEST = 1e-4
"""Smallest voxel size, in working units: far below the spacing of the fine clouds, and small_gicp's grid has room."""


@dataclass(frozen=True)
class Level:
    """Both clouds at one resolution, in working coordinates, and the spacing of their points."""

    source: Points
    target: Points
    spacing: float

    @cached_property
    def surfaces(self) -> Surfaces:
        """The clouds with normals, ready for refinement."""
        return Surfaces(Refinable.build(self.source), Refinable.build(self.target), self.spacing)

    @property
    def size(self) -> int:
        """Points of the larger cloud."""
        return max(len(self.source), len(self.target))

    def swapped(self) -> Level:
        """With source and target exchanged."""
        return Level(self.target, self.source, self.spacing)


@dataclass(frozen=True)
class Pyramid:
    """Both clouds at the resolutions that features are matched on, and at that of the last refinement.

    Attributes:
        small: what the network sees, and what is matched first.
        fine: for the last refinement.
        all_small: whether there are no larger clouds to match: the small ones hold all points, or the caller chose
            them.
        exchanged: whether what is called the source here is the caller's target.
    """

    small: Level
    fine: Level
    all_small: bool = False
    exchanged: bool = False

    @cached_property
    def larger(self) -> Level:
        """What is matched where the small clouds do not settle the matter: made only then."""
        return self.small if self.all_small else level(self.fine.source, self.fine.target, MATCHING_POINTS)

    def swapped(self) -> Pyramid:
        """With source and target exchanged."""
        return Pyramid(self.small.swapped(), self.fine.swapped(), self.all_small, not self.exchanged)


def build_pyramid(source: Points, target: Points, voxel_size: float | None) -> Pyramid:
    """The clouds at all resolutions.

    Args:
        source: working points (N, 3).
        target: working points (P, 3).
        voxel_size: of the clouds to match, in working units; None to take it from the data.

    Raises:
        InputError: too few or too many points are left to match.
    """
    fine = level(source, target, FINE_POINTS)
    if voxel_size is None:
        small = level(fine.source, fine.target, NETWORK_POINTS)
        _check_number(small.source, small.target)
        return Pyramid(small, fine, all_small=fine.size <= NETWORK_POINTS)
    voxel_size = max(voxel_size, FINEST)
    few = downsample(fine.source, voxel_size), downsample(fine.target, voxel_size)
    _check_number(*few)
    return Pyramid(Level(few[0], few[1], max(map(spacing_of, few))), fine, all_small=True)


def _check_number(source: Points, target: Points) -> None:
    for name, points in (("source", source), ("target", target)):
        if len(points) < MIN_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at the network's resolution, at least {MIN_POINTS} are needed; "
                "crop the other cloud to its size, or give a smaller voxel_size"
            )
        if len(points) > MOST_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at this voxel_size, at most {MOST_POINTS} fit the network; "
                "give a larger voxel_size"
            )


def level(source: Points, target: Points, count: int) -> Level:
    """Both clouds on one voxel grid that leaves about ``count`` points of the larger."""
    voxel_size = choose_voxel_size([source, target], count)
    if voxel_size > 0:
        source, target = downsample(source, voxel_size), downsample(target, voxel_size)
    else:  # a voxel grid merges copies of a point, too
        source, target = np.unique(source, axis=0), np.unique(target, axis=0)
    return Level(source, target, max(spacing_of(source), spacing_of(target)))


def spacing_of(points: Points) -> float:
    """The median distance of a point of (N, 3) to its nearest neighbour at another place, of some of the points."""
    some = points[:: max(1, len(points) // SAMPLE)]
    distance = cKDTree(points, compact_nodes=False, balanced_tree=False).query(some, k=2)[0][:, 1]
    return float(np.median(distance[distance > 0]))
