"""What rays from one place meet: scenes of convex solids and ground in closed form, drilled parts, triangle meshes.

A pair of scans is drawn anew at every training step, so each of them has to take a fraction of a second. Solids are
boxes, elliptic cylinders and ellipsoids; in its own coordinates each is a unit shape that a ray enters and leaves once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ground", "Hits", "Solid", "cast", "cast_drilled", "depth_image"]

Array = NDArray[np.float64]
Kind = Literal["box", "cylinder", "ellipsoid"]

NEAREST = 1e-6
"""Distance below which a ray has left a surface and does not meet it again."""
STEPS = 28
"""Places along a ray, in geometric progression, where relief is looked at: hills are longer than what lies between."""
BISECTIONS = 30
"""Halvings of the interval where a ray goes into the ground: rounding is reached."""
PIXELS = 2_000_000
"""Pairs of a triangle and a pixel that are looked at together, in some 200 MB."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex solid.

    Attributes:
        kind: box, cylinder (its axis is its third) or ellipsoid.
        centre: (3,).
        half: half its lengths along its axes, (3,).
        axes: its axes as columns (3, 3), a rotation.
        label: the number of the object that it belongs to, or -1 for scenery.
    """

    kind: Kind
    centre: Array
    half: Array
    axes: Array
    label: int = -1

    def local(self, points: Array) -> Array:
        """Points (N, 3) in coordinates where the solid is a unit shape."""
        unit: Array = (points - self.centre) @ self.axes / self.half
        return unit

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which points (N, 3) are strictly inside."""
        unit = np.abs(self.local(points)) * (1 + 1e-9)
        if self.kind == "box":
            return np.asarray((unit < 1).all(1))
        if self.kind == "cylinder":
            return np.asarray((np.hypot(unit[:, 0], unit[:, 1]) < 1) & (unit[:, 2] < 1))
        return np.asarray(np.linalg.norm(unit, axis=1) < 1)


@dataclass(frozen=True)
class Ground:
    """Terrain about z = 0: a sum of waves; a plane without any.

    Attributes:
        amplitude: (W,).
        frequency: wave vectors (W, 2), radians per unit.
        phase: (W,).
    """

    amplitude: Array
    frequency: Array
    phase: Array

    @classmethod
    def flat(cls) -> Ground:
        """The plane z = 0."""
        return cls(np.empty(0), np.empty((0, 2)), np.empty(0))

    def height(self, x: Array, y: Array) -> Array:
        """Of the terrain at places (...)."""
        total = np.zeros(np.shape(x))
        for amplitude, (fx, fy), phase in zip(self.amplitude, self.frequency, self.phase, strict=True):
            total += amplitude * np.sin(fx * x + fy * y + phase)
        return total


@dataclass(frozen=True)
class Hits:
    """What N rays meet: how far away (N,), infinite where nothing; and the label (N,) of what they meet."""

    distance: Array
    label: NDArray[np.int64]


def cast(solids: Sequence[Solid], ground: Ground | None, origin: Array, directions: Array, reach: float) -> Hits:
    """What rays from ``origin`` (3,) along unit ``directions`` (N, 3) meet first, within ``reach``."""
    rays = np.ascontiguousarray(directions.T)
    distance, label = np.full(len(directions), np.inf), np.full(len(directions), -1)
    if ground is not None:
        distance = _into_the_ground(ground, origin, rays, reach)
    for solid in solids:
        towards = solid.centre - origin
        away, radius = float(np.linalg.norm(towards)), float(np.linalg.norm(solid.half))
        if away - radius > reach:
            continue
        rows: Any = slice(None)
        if away > radius:  # only rays in the cone about the solid's sphere
            rows = np.flatnonzero(towards @ rays > np.sqrt(away**2 - radius**2))
        enter, leave = _interval(solid, origin, rays[:, rows])
        met = np.where(enter > NEAREST, enter, leave)
        nearer = (enter <= leave) & (met > NEAREST) & (met < distance[rows])
        distance[rows] = np.where(nearer, met, distance[rows])
        label[rows] = np.where(nearer, solid.label, label[rows])
    distance[distance > reach] = np.inf
    label[np.isinf(distance)] = -1
    return Hits(distance, label)


def cast_drilled(solids: Sequence[Solid], holes: Sequence[Solid], origin: Array, directions: Array) -> Array:
    """How far rays (N, 3) from a place outside go (N,) to the union of solids less the holes; infinite where past.

    The surface that a ray meets first is where it enters a solid outside of every hole, or leaves a hole in a solid.
    """
    rays = np.ascontiguousarray(directions.T)
    made = [_interval(solid, origin, rays) for solid in solids]
    drilled = [_interval(hole, origin, rays) for hole in holes]
    distance = np.full(len(directions), np.inf)
    for enter, leave in made:
        meets = (enter <= leave) & (enter > NEAREST) & ~_within(enter, drilled)
        np.minimum(distance, np.where(meets, enter, np.inf), out=distance)
    for n, (enter, leave) in enumerate(drilled):
        meets = (enter <= leave) & (leave > NEAREST)
        meets &= _within(leave, made) & ~_within(leave, drilled[:n] + drilled[n + 1 :])
        np.minimum(distance, np.where(meets, leave, np.inf), out=distance)
    return distance


def _within(distance: Array, intervals: list[tuple[Array, Array]]) -> NDArray[np.bool_]:
    """Whether points at distances (N,) along the rays lie in any of the intervals."""
    inside = np.zeros(len(distance), bool)
    for enter, leave in intervals:
        inside |= (enter < distance) & (distance < leave)
    return inside


def _interval(solid: Solid, origin: Array, rays: Array) -> tuple[Array, Array]:
    """Where rays (3, N) enter and leave a solid, (N,) each; one that misses it leaves before it enters."""
    start = (origin - solid.centre) @ solid.axes / solid.half
    along = (solid.axes / solid.half).T @ rays
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    flat = {"box": [0, 1, 2], "cylinder": [2], "ellipsoid": []}[solid.kind]
    round_ = {"box": [], "cylinder": [0, 1], "ellipsoid": [0, 1, 2]}[solid.kind]
    enter, leave = np.full(rays.shape[1], -np.inf), np.full(rays.shape[1], np.inf)
    for axis in flat:
        middle, half = -start[axis] / along[axis], 1.0 / np.abs(along[axis])
        enter, leave = np.maximum(enter, middle - half), np.minimum(leave, middle + half)
    if round_:
        a = np.einsum("in,in->n", along[round_], along[round_])
        b = start[round_] @ along[round_]
        squared = b * b - a * (start[round_] @ start[round_] - 1)
        root = np.sqrt(squared.clip(0))
        missed = np.where(squared < 0, np.inf, 0.0)
        enter, leave = np.maximum(enter, (-b - root) / a + missed), np.minimum(leave, (root - b) / a - missed)
    return enter, leave


def _into_the_ground(ground: Ground, origin: Array, rays: Array, reach: float) -> Array:
    """How far rays (3, N) go to the terrain, (N,)."""
    if len(ground.amplitude) == 0:
        down = np.where(rays[2] < -1e-9, rays[2], -1e-9)
        return np.where(rays[2] < -1e-9, -origin[2] / down, np.inf)
    distance = np.full(rays.shape[1], np.inf)
    peak = float(np.abs(ground.amplitude).sum())
    # none that stays above the peaks
    rows = np.flatnonzero(origin[2] + reach * rays[2] < peak)
    rays = rays[:, rows]

    def above(t: Array) -> Array:
        x, y, z = (start + t * ray for start, ray in zip(origin, rays, strict=True))
        over: Array = z - ground.height(x, y)
        return over

    low, high = np.zeros(len(rows)), np.full(len(rows), np.inf)
    for step in np.geomspace(0.02 * reach, reach, STEPS):
        below = np.isinf(high) & (above(np.full(len(rows), step)) < 0)
        high[below] = step
        low[np.isinf(high)] = step
    into = np.isfinite(high)
    rows, rays, low, high = rows[into], rays[:, into], low[into], high[into]
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        over = above(middle) > 0
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    distance[rows] = high
    return distance


def depth_image(triangles: Array, rays: Array) -> Array:
    """How far along z (H, W) the rays of a pinhole camera meet a triangle mesh first; infinite where they pass it.

    A ray (x, y, 1) is in a triangle where its products with the three planes through the camera and an edge agree in
    sign, and meets it at the triangle's determinant by their sum. Every triangle is compared with the pixels that it
    spans.

    Args:
        triangles: corners (F, 3, 3) in the camera's coordinates, all before it (z > 0).
        rays: what x and y of the rays are along the columns and the rows: the same even steps (H,), for a square image.
    """
    size, step = len(rays), rays[1] - rays[0]
    seen = triangles[..., :2] / triangles[..., 2:]
    low = np.ceil((seen.min(1) - rays[0]) / step - 1e-9).astype(np.int64).clip(0, size)
    high = np.floor((seen.max(1) - rays[0]) / step + 1e-9).astype(np.int64).clip(-1, size - 1)
    spans = (high - low + 1).clip(0)
    a, b, c = triangles.transpose(1, 0, 2)
    edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
    volume = np.einsum("fi,fi->f", a, edges[:, 0])
    depth = np.full(size * size, np.inf)
    number = spans.prod(1)
    for faces in np.array_split(np.arange(len(triangles)), max(1, -(-int(number.sum()) // PIXELS))):
        face = np.repeat(faces, number[faces])
        place = np.arange(len(face)) - np.repeat(number[faces].cumsum() - number[faces], number[faces])
        row, column = np.divmod(place, spans[face, 0].clip(1))
        row, column = row + low[face, 1], column + low[face, 0]
        products = (
            edges[face, :, 0] * rays[column][:, None] + edges[face, :, 1] * rays[row][:, None] + edges[face, :, 2]
        )
        inside = (products >= 0).all(1) | (products <= 0).all(1)
        total = products.sum(1)
        inside &= total != 0
        np.minimum.at(depth, row[inside] * size + column[inside], volume[face[inside]] / total[inside])
    return depth.reshape(size, size)
