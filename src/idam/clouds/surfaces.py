"""A cloud as a surface: normals, covariances and a search tree, made once."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from idam import rigid
from idam.rigid import Array, Rows

__all__ = ["TOUCHING", "Surface", "Surfaces", "nearest_within", "spacing_of"]

TOUCHING = 1.5
"""Spacings within which a transform makes two points one."""
SAME_SURFACE = 0.7
"""|cosine| of the normals from which two near points count as the same surface (45 degrees)."""
NEIGHBOURS = 15
"""Points that each normal and covariance is estimated from."""
SAMPLE = 1000
"""Points at least whose nearest neighbours tell the spacing of a cloud."""


@dataclass(frozen=True)
class Surface:
    """What fine alignment and scoring need of a cloud.

    Attributes:
        cloud: small_gicp's point cloud, with normals and covariances.
        tree: small_gicp's search tree of it.
    """

    cloud: Any
    tree: Any

    @classmethod
    def of(cls, points: Array) -> Surface:
        """From points (N, 3) in working coordinates."""
        import small_gicp

        cloud = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=min(NEIGHBOURS, len(points)))
        return cls(cloud, tree)

    @cached_property
    def points(self) -> Array:
        """(N, 3)."""
        return np.ascontiguousarray(self.cloud.points()[:, :3])

    @cached_property
    def normals(self) -> Array:
        """(N, 3), of either sign."""
        return np.ascontiguousarray(self.cloud.normals()[:, :3])

    def nearest(self, points: Array) -> tuple[Array, Rows]:
        """The distance (M,) from points (M, 3) to this cloud's nearest, and its row (M,)."""
        row, square = self.tree.batch_knn_search(points, 1)
        return np.sqrt(square[:, 0]), row[:, 0].astype(np.int64)


@dataclass(frozen=True)
class Surfaces:
    """Two surfaces in working coordinates, and the spacing of their points."""

    source: Surface
    target: Surface
    spacing: float
    _asked: dict[bytes, tuple[Array, Rows]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def nearest(self, transformation: Array) -> tuple[Array, Rows]:
        """The distance (N,) from each source point, moved by a transform (4, 4), to the nearest target point, its row.

        The last answer is kept: what overlaps, what is alike and what is left are asked of one pose after the other.
        """
        pose = transformation.tobytes()
        if pose not in self._asked:
            self._asked.clear()
            self._asked[pose] = self.target.nearest(rigid.apply(transformation, self.source.points))
        return self._asked[pose]

    def touching(self, transformation: Array, reach: float = TOUCHING) -> tuple[Array, Rows, Rows]:
        """What lies on what under a transform (4, 4): source points within ``reach`` spacings of a target point.

        Returns:
            For each of the C source points that lie on the target the distance to the nearest target point, the row of
            the source point and the row of that target point, (C,) each.
        """
        distance, row = self.nearest(transformation)
        on = np.flatnonzero(distance <= reach * self.spacing)
        return distance[on], on, row[on]

    def alike(self, transformation: Array, reach: float = TOUCHING) -> tuple[Rows, Rows]:
        """Rows of :meth:`touching` points whose normals agree, of the source and of the target, (C,) each."""
        _, mine, theirs = self.touching(transformation, reach)
        normals = self.source.normals[mine] @ transformation[:3, :3].T
        agree = np.abs((normals * self.target.normals[theirs]).sum(1)) >= SAME_SURFACE
        return mine[agree], theirs[agree]

    @cached_property
    def swapped(self) -> Surfaces:
        """With source and target exchanged."""
        return Surfaces(self.target, self.source, self.spacing)


def spacing_of(points: Array) -> float:
    """The median distance of a point of (N, 3) to its nearest neighbour at another place, of some of the points."""
    import small_gicp

    some = points[:: max(1, len(points) // SAMPLE)]
    square = small_gicp.KdTree(points).batch_knn_search(some, 2)[1][:, 1]
    return float(np.sqrt(np.median(square[square > 0])))


def nearest_within(points: Array, cloud: Array, distance: float) -> tuple[Rows, Array]:
    """Rows (C, 2) of points (N, 3) and of their nearest in a cloud (P, 3) within a distance, and how far, (C,)."""
    import small_gicp

    row, square = small_gicp.KdTree(cloud).batch_knn_search(points, 1)
    near = np.flatnonzero(square[:, 0] <= distance**2)
    return np.stack([near, row[near, 0].astype(np.int64)], 1), np.sqrt(square[near, 0])
