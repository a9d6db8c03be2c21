"""Two clouds at several resolutions, each for one purpose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from idam.errors import InputError
from idam.preprocess import MIN_POINTS, choose_voxel_size, downsample
from idam.refine import Refinable

__all__ = ["Level", "Pyramid", "Surfaces", "build_pyramid", "level", "spacing_of"]

Points = NDArray[np.float64]

NETWORK_POINTS = 1024
"""Points of the larger cloud that the network sees: what it was trained on."""
MATCHING_POINTS = 2000
"""Points of the larger cloud that features are matched on."""
DENSE_POINTS = 4096
"""Points of the larger cloud that hypotheses are refined and scored on."""
FINE_POINTS = 10_000
"""Points of the larger cloud that the last refinement uses."""
SAMPLE = 2000
"""Points at least whose nearest neighbours tell the spacing of a cloud."""
FINEST = 1e-4
"""Smallest voxel size, in working units: far below the spacing of the fine clouds, and small_gicp's grid has room."""


@dataclass(frozen=True)
class Surfaces:
    """Both clouds at one resolution, ready for refinement, and the spacing of their points."""

    source: Refinable
    target: Refinable
    spacing: float


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

    def swapped(self) -> Level:
        """With source and target exchanged."""
        return Level(self.target, self.source, self.spacing)


@dataclass(frozen=True)
class Pyramid:
    """Both clouds for the network, for matching features, for ranking hypotheses, and for the last refinement."""

    small: Level
    matching: Level
    dense: Level
    fine: Level

    @property
    def levels(self) -> tuple[Level, ...]:
        """All of them, the coarsest first."""
        return self.small, self.matching, self.dense, self.fine

    def swapped(self) -> Pyramid:
        """With source and target exchanged."""
        return Pyramid(*(level.swapped() for level in self.levels))


def build_pyramid(source: Points, target: Points, voxel_size: float | None) -> Pyramid:
    """The clouds at all resolutions.

    Args:
        source: working points (N, 3).
        target: working points (P, 3).
        voxel_size: of the two coarse levels, in working units; None to take it from the data.

    Raises:
        InputError: too few or too many points are left at the coarse levels.
    """
    fine = level(source, target, FINE_POINTS)
    dense = level(fine.source, fine.target, DENSE_POINTS)
    if voxel_size is None:
        matching = level(fine.source, fine.target, MATCHING_POINTS)
        small = level(dense.source, dense.target, NETWORK_POINTS)
        _check_number(small.source, small.target)
    else:
        voxel_size = max(voxel_size, FINEST)
        few = downsample(fine.source, voxel_size), downsample(fine.target, voxel_size)
        _check_number(*few)
        small = matching = Level(few[0], few[1], max(map(spacing_of, few)))
    return Pyramid(small, matching, dense, fine)


def _check_number(source: Points, target: Points) -> None:
    for name, points in (("source", source), ("target", target)):
        if len(points) < MIN_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at the network's resolution, at least {MIN_POINTS} are needed; "
                "crop the other cloud to its size, or give a smaller voxel_size"
            )
        if len(points) > DENSE_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at this voxel_size, at most {DENSE_POINTS} fit the network; "
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
