"""What a scanner saw through: the free space between the place that a scan was taken from and its points.

Most scans come in their scanner's frame. Whether one does shows in the scan itself. Seen from its origin, it has one
surface in every direction, where a model or a merged cloud has several behind each other; and about as many points in
directions where it sees far as where it sees near, where a model has more the farther. If so, whatever the other cloud
has well in front of that surface contradicts a transform: the scanner would have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import Surface
from idam.rigid import Array

__all__ = ["DepthMap", "FreeSpace", "seen_from"]

PER_CELL = 3.0
"""Points of a direction's cell, in the mean of those that have any."""
CELLS = 8, 128
"""Least and most cells along the edge of each face of the cube that directions are sorted by."""
BEHIND, ASIDE = 1.3, 0.15
"""Ratio of the distances of two points in one cell, and share of the gap between them that leads off the surface of
both, from which on one lies behind the other: flat ground far away is one surface."""
SEVERAL = 0.04
"""Share of neighbours in a cell that lie behind each other, above which a cloud is not what one place sees. Of 80
ray-cast scans it is 0 to 0.034 and once 0.062, of two of a real LiDAR 0.031 and 0.035, of models up to 0.12."""
COARSE = 12
"""Cells along a face's edge that points are counted in."""
SPREAD = 0.2
"""Standard deviation of the logarithm of the distance from which on a scanner is told from a model."""
SLOPE = -1.0, 0.4
"""Powers of the distance that the number of points in a direction grows by. Of 80 ray-cast scans it is -0.91 to 0.19
and once 0.47, of two of a real LiDAR -0.3, of models and thinned scans 0.66 to 3.8, or below -1.9."""
SOME = 10_000
"""Points that tell whether there are as many in directions where a scan sees far."""
FEWEST = 20
"""Points in seen directions below which a share of them says nothing."""

RAYS = 4
"""Nearest rays of a scan that tell what it sees in a direction: a point must lie in front of all of them."""
GAPS, NEIGHBOUR = 1.2, 5
"""A direction counts as seen where the last of those rays is no farther than this many times the distance from the
first one to its fifth neighbour."""
SLACK = 0.03
"""Share of the distance by which a point must lie in front, besides a margin: surfaces are seen at a slant."""
BENT = 0.7, 1.4
"""Shares of a ray's length within which its tangent plane tells what is seen beside it."""
ASKED = 1500
"""Points of each cloud that are asked at most: a share of 0.001 is then three of them."""


@dataclass(frozen=True)
class DepthMap:
    """How far a scan sees in every direction: to the tangent planes of the points seen next to it.

    On flat ground far away a ray's length changes fast from one to the next, and a box that stands on it is lower than
    that: lengths alone do not show it.

    Attributes:
        eye: where it was taken from, (3,).
        points: seen from there, relative to it, (N, 3).
        normals: of the surface at each, (N, 3).
        length: of each ray, (N,).
        tree: of the rays' directions.
        beside: how far other rays are from each, (N,).
    """

    eye: Array
    points: Array
    normals: Array
    length: Array
    tree: Any
    beside: Array

    @classmethod
    def of(cls, surface: Surface, eye: Array) -> DepthMap:
        """Of a surface seen from a place."""
        import small_gicp

        ray = surface.points - eye
        length = np.linalg.norm(ray, axis=1)
        seen = length > 0
        direction = ray[seen] / length[seen, None]
        tree = small_gicp.KdTree(direction)
        square = tree.batch_knn_search(direction, min(NEIGHBOUR + 1, len(direction)))[1]
        return cls(eye, ray[seen], surface.normals[seen], length[seen], tree, np.sqrt(square[:, -1]))

    def seen_through(self, points: Array, margin: float) -> tuple[int, int]:
        """Of the points (M, 3) in seen directions, how many lie in front of what was seen, and how many do not.

        In front means clear of the tangent planes by more than a margin, and nearer than they are by a share.
        """
        ray = points - self.eye
        length = np.linalg.norm(ray, axis=1)
        ray, length = ray[length > 0], length[length > 0]
        if len(ray) == 0 or len(self.points) < RAYS:
            return 0, 0
        direction = ray / length[:, None]
        row, square = self.tree.batch_knn_search(direction, RAYS)
        row = row.astype(np.int64)
        seen = np.sqrt(square[:, -1]) <= GAPS * self.beside[row[:, 0]]
        ray, length, direction, row = ray[seen], length[seen], direction[seen], row[seen]
        normals, nearest = self.normals[row], self.length[row]
        offset = (normals * self.points[row]).sum(-1)
        slant = np.einsum("mkd,md->mk", normals, direction)
        steep = np.abs(slant) * BENT[1] * nearest > np.abs(offset)  # the others meet the plane too far away, or never
        plane = np.where(steep, offset / np.where(steep, slant, 1.0), BENT[1] * nearest)
        reach = np.minimum(nearest, plane.clip(BENT[0] * nearest, None)).min(1)
        clear = np.abs(np.einsum("mkd,md->mk", normals, ray) - offset).min(1)
        front = (length < (1 - SLACK) * reach) & (clear > margin)
        return int(front.sum()), int((~front).sum())


@dataclass(frozen=True)
class FreeSpace:
    """What two scans saw through, and the points that it is asked of, in working coordinates.

    Attributes:
        source: points (N, 3).
        target: points (P, 3).
        source_depth: of the source's scan, or None.
        target_depth: of the target's.
        margin: by which a point must lie in front of a surface.
    """

    source: Array
    target: Array
    source_depth: DepthMap | None
    target_depth: DepthMap | None
    margin: float

    @classmethod
    def of(cls, source: Surface, target: Surface, eyes: tuple[Array | None, Array | None], margin: float) -> FreeSpace:
        """Of two surfaces, seen from known places or from no one place."""
        some = [surface.points[:: len(surface.points) // ASKED + 1] for surface in (source, target)]
        maps = [
            None if eye is None else DepthMap.of(surface, eye)
            for surface, eye in zip((source, target), eyes, strict=True)
        ]
        return cls(some[0], some[1], maps[0], maps[1], margin)

    def violation(self, transformation: Array) -> float:
        """The share of points that a transform (4, 4) puts where the other scan saw through; 0 if nothing is known."""
        front = behind = 0
        ways = (
            (self.target_depth, self.source, transformation),
            (self.source_depth, self.target, rigid.inverse(transformation)),
        )
        for depth, points, way in ways:
            if depth is not None:
                some = depth.seen_through(rigid.apply(way, points), self.margin)
                front, behind = front + some[0], behind + some[1]
        return front / (front + behind) if front + behind >= FEWEST else 0.0


def seen_from(points: Array, surface: Surface, eye: Array) -> bool:
    """Whether points (N, 3), and the surface that thinning leaves of them, are what one place (3,) sees."""
    ray = points - eye
    distance = np.linalg.norm(ray, axis=1)
    ray, distance = ray[distance > 0], distance[distance > 0]
    step = len(ray) // SOME + 1
    return _even(ray[::step], distance[::step]) and _single(surface.points - eye, surface.normals)


def _single(ray: Array, normals: Array) -> bool:
    """Whether rays (N, 3) end on one surface in every direction, by the normals (N, 3) there."""
    edge = CELLS[1]
    cell = _cells(ray, edge)
    while edge > CELLS[0] and len(cell) < PER_CELL * len(np.unique(cell)):
        edge = int(edge / 2**0.5)
        cell = _cells(ray, edge)
    distance = np.linalg.norm(ray, axis=1)
    order = np.lexsort((distance, cell))
    together = np.flatnonzero(np.diff(cell[order]) == 0)
    near, far = order[together], order[together + 1]
    gap = ray[far] - ray[near]
    off = np.minimum(*(np.abs((gap * normals[rows]).sum(1)) for rows in (near, far)))
    behind = (distance[far] > BEHIND * distance[near]) & (off > ASIDE * np.linalg.norm(gap, axis=1))
    return len(behind) > 0 and bool(behind.mean() <= SEVERAL)


def _even(ray: Array, distance: Array) -> bool:
    """Whether rays (N, 3) are as many where the distance (N,) is large as where it is small."""
    cell = _cells(ray, COARSE)
    count = np.bincount(cell)
    far = np.log(np.bincount(cell, distance)[count > PER_CELL] / count[count > PER_CELL])
    count = count[count > PER_CELL]
    if len(count) < FEWEST:
        return False
    weight = np.sqrt(count) / np.sqrt(count).sum()
    far = far - weight @ far
    spread = float(weight @ far**2)
    slope = float(weight @ (far * np.log(count))) / spread if spread > 0 else 0.0
    return spread > SPREAD**2 and SLOPE[0] < slope < SLOPE[1]


def _cells(ray: Array, edge: int) -> NDArray[np.int64]:
    """The cell (N,) of a cube around the origin that each ray (N, 3) passes."""
    size = np.abs(ray)
    axis = size.argmax(1)[:, None]
    longest = np.take_along_axis(ray, axis, 1)
    across = [np.take_along_axis(ray, (axis + k) % 3, 1) / np.maximum(np.abs(longest), 1e-300) for k in (1, 2)]
    row, column = (((x[:, 0] + 1) / 2 * edge).astype(np.int64).clip(0, edge - 1) for x in across)
    face = 2 * axis[:, 0] + (longest[:, 0] > 0)
    numbers: NDArray[np.int64] = (face * edge + row) * edge + column
    return numbers
