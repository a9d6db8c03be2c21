"""Pairs of patches: what small pieces of both surfaces, where they lie on each other, say of a transform."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from idam import rigid
from idam.clouds.surfaces import NEIGHBOURS, SAME_SURFACE, SAMPLE, Surfaces
from idam.describe.normals import least_variance
from idam.rigid import Array

__all__ = ["Dense", "Pairs", "Patches", "patch_size"]

STRAY = 3.0
"""Robust standard deviations by which patches lie apart when they have lost three quarters of their weight."""
TANGENT = 0.5
"""Distance of two patches' centres along the surface, in radii of the neighbourhood that the normal is from, past which
one of the clouds ends where the other goes on."""
THICK = 6.0
"""Standard deviations of the noise that a patch reaches. Thinner ones have no plane, and their means follow the place
they are asked at: with noise of one spacing, patches of 7 points (3 standard deviations) end 1.4 times as far off as of
30 (6)."""
LARGEST = 60
"""Points of a patch at most."""
BLOCK, EXCERPT = 8.0, 8000
"""Spacings of the thinned points along a block of those not thinned, and how many of these tell their noise: a tree of
all takes longer than the rest of the last stage."""


@dataclass(frozen=True)
class Patches:
    """Small pieces of a surface, or points of it: centres (C, 3) and normals (C, 3)."""

    centres: Array
    normals: Array


@dataclass(frozen=True)
class Dense:
    """A cloud's points (N, 3) in working coordinates, and a search tree of them."""

    points: Array
    tree: Any = field(repr=False)

    @classmethod
    def of(cls, points: Array) -> Dense:
        """From points (N, 3)."""
        import small_gicp

        return cls(points, small_gicp.KdTree(points))

    def patches(self, places: Array, size: int) -> tuple[Patches, Array, Array]:
        """The means of the ``size`` points nearest to each of the places (C, 3), with normals of more where few.

        Returns:
            The patches, their radii (C,) and the standard deviations (C,) of points off their planes.
        """
        row, square = self.tree.batch_knn_search(places, min(max(size, NEIGHBOURS), len(self.points)))
        near = np.stack([coordinate.take(row) for coordinate in self.points.T])
        spread = near - near.mean(2, keepdims=True)
        covariance = np.einsum("ink,jnk->nij", spread, spread) / (row.shape[1] - 3)
        normals, variance = least_variance(covariance, places)
        return Patches(near[:, :, :size].mean(2).T, normals), np.sqrt(square[:, -1]), np.sqrt(variance.clip(0))


@dataclass(frozen=True)
class Pairs:
    """Patches of the source with those of the target that they lie on, all in the source's coordinates.

    Attributes:
        points: centres of the source's, (C, 3).
        source_normals: (C, 3).
        target_normals: (C, 3), to the same side.
        gaps: vectors from the target's centre to the source's, (C, 3).
        response: what the residuals change by as the source moves, as a share of the way: below 1 where the means of
            patches follow the place that they are asked for at.
    """

    points: Array
    source_normals: Array
    target_normals: Array
    gaps: Array
    response: float = 1.0

    @classmethod
    def of_points(cls, surfaces: Surfaces, transformation: Array) -> Pairs:
        """Each point of the source with the target's nearest, where a transform (4, 4) lays it on the target."""
        _, mine, row = surfaces.touching(transformation)
        source, target = surfaces.source, surfaces.target
        one = Patches(source.points[mine], source.normals[mine])
        return cls.alike(one, Patches(target.points[row], target.normals[row]), transformation)

    @classmethod
    def of_patches(cls, source: Patches, places: Array, target: Dense, transformation: Array, size: int) -> Pairs:
        """Each patch of the source with the target's where a transform (4, 4) lays it, if one goes on as the other.

        Both lie around the same places (C, 3): where these lie off the surface, both means follow them alike.
        """
        other, radii, _ = target.patches(rigid.apply(transformation, places), size)
        gaps = rigid.apply(transformation, source.centres) - other.centres
        near = np.linalg.norm(gaps, axis=1) <= TANGENT * radii
        one = Patches(source.centres[near], source.normals[near])
        return cls.alike(one, Patches(other.centres[near], other.normals[near]), transformation)

    @classmethod
    def alike(cls, source: Patches, target: Patches, transformation: Array) -> Pairs:
        """Those whose normals agree, in the source's coordinates."""
        gaps = source.centres - rigid.apply(rigid.inverse(transformation), target.centres)
        normals = target.normals @ transformation[:3, :3]
        cosine = (source.normals * normals).sum(1)
        on = np.flatnonzero(np.abs(cosine) >= SAME_SURFACE)
        normals = normals * np.copysign(1.0, cosine)[:, None]
        return cls(source.centres[on], source.normals[on], normals[on], gaps[on])

    @cached_property
    def normals(self) -> Array:
        """Between both normals, (C, 3).

        Along it two points of one curved surface are no distance apart, to second order (Rusinkiewicz 2019).
        """
        both = self.source_normals + self.target_normals
        return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True))

    @cached_property
    def residuals(self) -> Array:
        """How far the source's patches lie above the target's, (C,)."""
        return np.asarray((self.gaps * self.normals).sum(1))

    @cached_property
    def weights(self) -> Array:
        """Less for what lies far off, (C,), at most 1."""
        return np.asarray((1 + self._relative) ** -2)

    @cached_property
    def slope(self) -> float:
        """What a weighted residual grows by as the source moves, over the mean weight: below 1, as weights fall."""
        growth = (1 - 3 * self._relative) * (1 + self._relative) ** -3
        return self.response * float(growth.mean() / self.weights.mean())

    @cached_property
    def scale(self) -> float:
        """The robust standard deviation of the residuals; infinite where there are none."""
        if len(self.points) == 0:
            return float("inf")
        return 1.4826 * float(np.median(np.abs(self.residuals)))

    @cached_property
    def _relative(self) -> Array:
        return np.asarray((self.residuals / (STRAY * max(self.scale, 1e-12))) ** 2)

    def each_way(self) -> Pairs:
        """The same pairs held along all three axes, as copies of points hold each other."""
        axes, count = np.repeat(np.eye(3), len(self.points), 0), (3, 1)
        return Pairs(np.tile(self.points, count), axes, axes, np.tile(self.gaps, count))

    def gradients(self, normals: Array) -> Array:
        """Derivatives (C, 6) of distances along normals (C, 3) by x, of T exp(x)."""
        return np.concatenate([np.cross(self.points, normals), normals], 1)


def patch_size(points: Array, spacing: float) -> int:
    """Points of a patch that reaches past the noise: 1 where the noise is far below the spacing of the points.

    Args:
        points: (N, 3), not thinned.
        spacing: of the thinned points.
    """
    size = 1
    points = excerpt(points, BLOCK * spacing)
    cloud = Dense.of(points)
    for _ in range(2):
        _, radii, noise = cloud.patches(points[:: max(1, len(points) // SAMPLE)], size)
        neighbours = max(size, NEIGHBOURS)
        size = int(np.clip(round(neighbours * float(np.median(THICK * noise / radii)) ** 2), 1, LARGEST))
        if size <= NEIGHBOURS:
            break
    return size


def excerpt(points: Array, side: float) -> Array:
    """All of the points (N, 3) in some blocks of space of a side, about :data:`EXCERPT` of them."""
    every = len(points) // EXCERPT + 1
    number = np.floor(points / side) @ np.array([1.0, 2.0, 3.0])
    some = points.compress(number % every == 0, axis=0)
    return some if len(some) > EXCERPT // 2 else points
