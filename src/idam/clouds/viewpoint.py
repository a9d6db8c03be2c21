"""What a scanner saw through: the free space between the place that a scan was taken from and its points.

Most scans come in their scanner's frame. Whether one does shows in the scan itself. Seen from its origin, it has one
surface in every direction, where a model or a merged cloud has several behind each other; and about as many points in
directions where it sees far as where it sees near, where a model has more the farther. If so, whatever the other cloud
has well in front of that surface contradicts a transform: the scanner would have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.rigid import Array

__all__ = ["DepthMap", "FreeSpace"]

PER_CELL = 3.0
"""Points of a direction's cell, in the mean of those that have any."""
CELLS = 8, 128
"""Least and most cells along the edge of each face of the cube that directions are sorted by."""
BEHIND = 1.3
"""Ratio of the distances of two points in one cell from which on one lies behind the other."""
SEVERAL = 0.02
"""Share of neighbours in a cell that lie behind each other, above which a cloud is not what one place sees. Of 60 real
and ray-cast scans in their scanner's frame it is 0 to 0.012, of merged clouds and strips 0.04 to 0.18."""
AROUND = 7
"""Of the nine cells around a direction, those that must have points for it to count as seen."""
SLACK = 0.03
"""Share of the distance by which a point must lie in front, besides a margin: surfaces are seen at a slant."""
COARSE = 12
"""Cells along a face's edge that points are counted in."""
SPREAD, SLOPE = 0.2, 0.4
"""Standard deviation of the logarithm of the distance that tells a scanner from a model; and the power of the distance
that the number of points in a direction grows by, at most. Of 33 scans in their scanner's frame it is -0.54 to 0.26, of
models, merged clouds and thinned scans 0.66 to 3.6."""
SOME = 10_000
"""Points that tell whether there are as many in directions where a scan sees far."""
FEWEST = 20
"""Points in seen directions below which a share of them says nothing."""


@dataclass(frozen=True)
class DepthMap:
    """How far a scan sees in every direction.

    Attributes:
        eye: where it was taken from, (3,).
        near: the least distance in each cell and those around it, infinite where it was not seen, (cells,).
        edge: cells along the edge of each face of the cube.
    """

    eye: Array
    near: Array
    edge: int

    @classmethod
    def of(cls, points: Array, eye: Array) -> DepthMap | None:
        """Of points (N, 3) seen from a place; None where no one sees all of them from there."""
        ray = points - eye
        distance = np.linalg.norm(ray, axis=1)
        ray, distance = ray[distance > 0], distance[distance > 0]
        step = len(ray) // SOME + 1
        if not _even(ray[::step], distance[::step]):
            return None
        edge = CELLS[1]
        cell = _cells(ray, edge)
        while edge > CELLS[0] and len(cell) < PER_CELL * len(np.unique(cell)):
            edge = int(edge / 2**0.5)
            cell = _cells(ray, edge)
        order = np.lexsort((distance, cell))
        cell, distance = cell[order], distance[order]
        together = cell[1:] == cell[:-1]
        behind = distance[1:][together] > BEHIND * distance[:-1][together]
        if len(behind) == 0 or behind.mean() > SEVERAL:
            return None
        first = np.r_[True, ~together]
        depth = np.full((6, edge, edge), np.inf)
        depth.reshape(-1)[cell[first]] = distance[first]
        return cls(eye, _nearest_around(depth).reshape(-1), edge)

    def scaled(self, unit: float) -> DepthMap:
        """The same in units of so many."""
        return DepthMap(self.eye / unit, self.near / unit, self.edge)

    def seen_through(self, points: Array, margin: float) -> tuple[int, int]:
        """Of the points (M, 3), how many lie in front of what was seen, by more than a margin, and how many do not."""
        ray = points - self.eye
        near = self.near[_cells(ray, self.edge)]
        seen = np.isfinite(near)
        front = np.linalg.norm(ray[seen], axis=1) < (1 - SLACK) * near[seen] - margin
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
    return spread > SPREAD**2 and abs(float(weight @ (far * np.log(count)))) < SLOPE * spread


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


def _nearest_around(depth: Array) -> Array:
    """The least of each cell and its neighbours (6, n, n) on its face; infinite where too few of them were seen."""
    n = depth.shape[1]
    padded = np.pad(depth, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
    around = np.stack([padded[:, i : i + n, j : j + n] for i in range(3) for j in range(3)])
    known = np.isfinite(depth) & (np.isfinite(around).sum(0) >= AROUND)
    return np.where(known, around.min(0), np.inf)
