"""Two clouds at several resolutions, each for one purpose, in working coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.frame import MIN_POINTS
from idam.clouds.prepared import FINE, LARGER, SMALL, SPARSE, Level, Prepared
from idam.clouds.surfaces import Surfaces
from idam.clouds.viewpoint import FreeSpace
from idam.describe.invariant import Descriptor
from idam.errors import InputError
from idam.rigid import Array

__all__ = ["PairLevel", "Pyramid"]

MOST_POINTS = 4096
"""Points of either cloud at most that features are matched on, where the caller chooses the voxel size."""
FINEST = 1e-4
"""Smallest voxel size, in working units: far below the spacing of the fine clouds, and small_gicp's grid has room."""
MARGIN = 2.0
"""Spacings of the fine clouds by which a point lies in front of a surface for it to contradict a transform."""
ODD_SIZES = 50.0
"""Ratio of two clouds' sizes from which on their units are probably not the same."""


@dataclass(frozen=True)
class PairLevel:
    """Both clouds at one resolution.

    Attributes:
        source_level: the source.
        target_level: the target.
        unit: input units in one working unit.
        free_space: what the scans saw through.
    """

    source_level: Level
    target_level: Level
    unit: float
    free_space: FreeSpace

    @cached_property
    def surfaces(self) -> Surfaces:
        """The clouds in working coordinates, with normals."""
        return Surfaces(self.source_level.surface(self.unit), self.target_level.surface(self.unit), self.spacing)

    @property
    def source(self) -> Array:
        """The source's points (N, 3) in working coordinates."""
        return self.surfaces.source.points

    @property
    def target(self) -> Array:
        """The target's points (P, 3) in working coordinates."""
        return self.surfaces.target.points

    @cached_property
    def spacing(self) -> float:
        """Of the sparser cloud's points, in working units."""
        return max(self.source_level.spacing, self.target_level.spacing) / self.unit

    @property
    def size(self) -> int:
        """Points of the larger cloud."""
        return max(len(self.source_level.points), len(self.target_level.points))

    def features(self, descriptor: Descriptor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What a descriptor makes of the source's and the target's points, (N, K) and (P, K), at one spacing."""
        spacing = max(level.spacing_rung for level in (self.source_level, self.target_level))
        return self.source_level.described(descriptor, spacing), self.target_level.described(descriptor, spacing)


@dataclass(frozen=True)
class Pyramid:
    """Both clouds at the resolutions that features are matched on, and at that of the last refinement.

    Working coordinates are relative to each cloud's own centre, in units about the radius of the larger cloud: a power
    of two, so that no digit changes.

    Attributes:
        source: the smaller cloud, or the one that is called the source.
        target: the other.
        voxel_size: of the clouds to match, in input units; None to take it from the data.
    """

    source: Prepared
    target: Prepared
    voxel_size: float | None = None

    @cached_property
    def unit(self) -> float:
        """Input units in one working unit."""
        return max(self.source.unit, self.target.unit)

    @cached_property
    def small(self) -> PairLevel:
        """What is matched first.

        Raises:
            InputError: too few or too many points are left to match.
        """
        if self.voxel_size is None:
            level = self.fine if self.sparse else self.with_points(SMALL)
        else:
            level = self.at(max(self.voxel_size, FINEST * self.unit))
        self._check(level)
        return level

    @cached_property
    def larger(self) -> PairLevel:
        """What is matched where the small clouds do not settle the matter."""
        return self.small if self.all_small else self.with_points(LARGER)

    @cached_property
    def fine(self) -> PairLevel:
        """What the last refinement uses."""
        return self.with_points(FINE)

    @property
    def sparse(self) -> bool:
        """Whether there are so few points that all of them are matched."""
        return self.fine.size <= SPARSE

    @property
    def all_small(self) -> bool:
        """Whether there are no larger clouds to match: the small ones hold all points, or the caller chose them."""
        return self.voxel_size is not None or self.sparse

    def with_points(self, count: int) -> PairLevel:
        """Both clouds on the voxel grid that leaves about ``count`` points of the larger."""
        return self.at(max(cloud.voxel_size(count) for cloud in (self.source, self.target)))

    def at(self, voxel_size: float) -> PairLevel:
        """Both clouds on a voxel grid, its size in input units."""
        return PairLevel(self.source.level(voxel_size), self.target.level(voxel_size), self.unit, self.free_space)

    @cached_property
    def free_space(self) -> FreeSpace:
        """What the scans saw through, asked of the fine clouds."""
        voxel_size = max(cloud.voxel_size(FINE) for cloud in (self.source, self.target))
        levels = [cloud.level(voxel_size) for cloud in (self.source, self.target)]
        eyes = [None if cloud.eye is None else cloud.eye / self.unit for cloud in (self.source, self.target)]
        margin = MARGIN * max(level.spacing for level in levels) / self.unit
        return FreeSpace.of(levels[0].surface(self.unit), levels[1].surface(self.unit), (eyes[0], eyes[1]), margin)

    def leave(self, working: Array) -> Array:
        """A working transform (..., 4, 4) as one from source to target in the input's coordinates."""
        rotation = working[..., :3, :3]
        shift = self.target.centre + self.unit * working[..., :3, 3] - rotation @ self.source.centre
        return rigid.transform(rotation, shift)

    def enter(self, full: Array) -> Array:
        """The inverse of :meth:`leave`."""
        rotation = full[..., :3, :3]
        shift = (full[..., :3, 3] + rotation @ self.source.centre - self.target.centre) / self.unit
        return rigid.transform(rotation, shift)

    def information_left(self, working: Array) -> Array:
        """The information (6, 6) of a working transform T exp(x) as that of the one in the input's coordinates.

        The input's x lives in the source's own frame, its translation in input units.
        """
        return rigid.carried(working, self.to_input)

    @property
    def to_input(self) -> Array:
        """The matrix (6, 6) that takes twists of the source's working frame to those of its input frame."""
        scale = np.diag([1.0, 1.0, 1.0, self.unit, self.unit, self.unit])
        return rigid.adjoint(rigid.transform(np.eye(3), self.source.centre)) @ scale

    def _check(self, level: PairLevel) -> None:
        both = (self.source, level.source_level), (self.target, level.target_level)
        for (cloud, thinned), (other, _) in zip(both, reversed(both), strict=True):
            left, ratio = len(thinned.points), other.radius / cloud.radius
            if ratio > ODD_SIZES and (left < MIN_POINTS or cloud.radius < level.spacing * self.unit):
                raise InputError(
                    f"{other.name}: {ratio:.0f} times the size of {cloud.name}; if their units differ, scale one of "
                    "them, or crop the larger cloud to the other's size"
                )
            if left < MIN_POINTS:
                raise InputError(
                    f"{cloud.name}: {left} points are left at a voxel size of {thinned.voxel_size:.3g}, at least "
                    f"{MIN_POINTS} are needed; crop the other cloud to its size, or give a smaller voxel_size"
                )
            if left > MOST_POINTS:
                raise InputError(
                    f"{cloud.name}: {left} points are left at this voxel_size, at most {MOST_POINTS} can be matched; "
                    "give a larger voxel_size"
                )
