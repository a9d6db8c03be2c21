"""Machined parts of our own: blocks, ribs and bosses along three axes, with holes drilled into them; flanges.

They are solids less holes, so that rays are cast and surfaces sampled in closed form, and no surface lies inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam.lab.data.raycast import Solid

__all__ = ["Drilled", "random_drilled", "random_flange"]

Array = NDArray[np.float64]

ALONG_AXES = (np.eye(3)[:, [1, 2, 0]], np.eye(3)[:, [2, 0, 1]], np.eye(3))
"""Axes of cylinders along x, y and z."""


@dataclass(frozen=True)
class Drilled:
    """The union of solids, less the holes."""

    solids: tuple[Solid, ...]
    holes: tuple[Solid, ...]

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """``count`` points (count, 3) uniformly on the surface, that inside holes included."""
        pieces, total = [], 0
        while total < count:
            drawn = _on_surfaces(self.solids + self.holes, 4 * count, rng)
            kept = [
                points[~_inside(points, self.solids[:n] + self.solids[n + 1 :]) & ~_inside(points, self.holes)]
                for n, points in enumerate(drawn[: len(self.solids)])
            ]
            for n, points in enumerate(drawn[len(self.solids) :]):
                others = self.holes[:n] + self.holes[n + 1 :]
                kept.append(points[_inside(points, self.solids) & ~_inside(points, others)])
            pieces.append(np.concatenate(kept))
            total += len(pieces[-1])
        points = np.concatenate(pieces)
        return points[rng.permutation(len(points))[:count]]


def _inside(points: Array, solids: tuple[Solid, ...]) -> NDArray[np.bool_]:
    """Which points (N, 3) are strictly inside any of the solids."""
    inside = np.zeros(len(points), bool)
    for solid in solids:
        inside |= solid.holds(points)
    return inside


def _on_surfaces(solids: tuple[Solid, ...], count: int, rng: np.random.Generator) -> list[Array]:
    """Points uniformly on boxes and round cylinders, some ``count`` together, by solid."""
    areas = [_areas(solid) for solid in solids]
    density = count / sum(float(area.sum()) for area in areas)
    return [_on_surface(*both, density, rng) for both in zip(solids, areas, strict=True)]


def _areas(solid: Solid) -> Array:
    """Of the pairs of faces of a box (3,), or of a cylinder's ends and mantle (2,)."""
    a, b, c = solid.half
    if solid.kind == "box":
        return 8 * np.array([b * c, a * c, a * b])
    return np.array([2 * np.pi * a * a, 4 * np.pi * a * c])


def _on_surface(solid: Solid, areas: Array, density: float, rng: np.random.Generator) -> Array:
    count = rng.poisson(density * areas)
    unit = rng.uniform(-1, 1, (int(count.sum()), 3))
    face = np.repeat(np.arange(len(count)), count)
    sides = rng.choice([-1.0, 1.0], len(unit))
    if solid.kind == "box":
        unit[np.arange(len(unit)), face] = sides
    else:
        angle, radius = np.pi * unit[:, 0], np.where(face == 0, np.sqrt(rng.random(len(unit))), 1.0)
        unit[:, :2] = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        unit[:, 2] = np.where(face == 0, sides, unit[:, 2])
    points: Array = (unit * solid.half) @ solid.axes.T + solid.centre
    return points


def random_drilled(rng: np.random.Generator) -> Drilled:
    """A block or plate with up to five blocks, ribs and bosses on it, and up to six holes, slots and pockets."""
    half = np.sort(rng.uniform(0.15, 0.8, 3))[::-1] * (1, 1, rng.uniform(0.2, 1))
    solids = [Solid("box", np.zeros(3), half, np.eye(3))]
    for _ in range(rng.integers(0, 6)):
        base = solids[int(rng.integers(len(solids)))]
        axis, side = int(rng.integers(3)), rng.choice([-1, 1])
        size = rng.uniform(0.05, 0.5, 3)
        centre = base.centre + rng.uniform(-0.9, 0.9, 3) * np.abs(base.axes @ base.half)
        centre[axis] = base.centre[axis] + side * (np.abs(base.axes @ base.half)[axis] + 0.7 * size[axis])
        if rng.random() < 0.6:
            solids.append(Solid("box", centre, size, np.eye(3)))
        else:
            solids.append(Solid("cylinder", centre, np.array([size[0], size[0], size[axis]]), ALONG_AXES[axis]))
    holes = []
    for _ in range(rng.integers(0, 7)):
        base, axis = solids[int(rng.integers(len(solids)))], int(rng.integers(3))
        reach = np.abs(base.axes @ base.half)
        centre = base.centre + rng.uniform(-0.8, 0.8, 3) * reach
        radius = float(reach[[n for n in range(3) if n != axis]].min() * rng.uniform(0.15, 0.6))
        # through, or blind from one side
        deep = 1.02 * reach[axis] if rng.random() < 0.6 else rng.uniform(0.3, 0.8) * reach[axis]
        centre[axis] = base.centre[axis] + rng.choice([-1, 1]) * (1.02 * reach[axis] - deep)
        if rng.random() < 0.75:
            holes.append(Solid("cylinder", centre, np.array([radius, radius, deep]), ALONG_AXES[axis]))
        else:
            slot = radius * rng.uniform(0.6, 2.5, 3)
            slot[axis] = deep
            holes.append(Solid("box", centre, slot, np.eye(3)))
    return Drilled(tuple(solids), tuple(holes))


def random_flange(rng: np.random.Generator) -> tuple[Drilled, int, Solid | None]:
    """A disc with a boss on one side, a bore, bolt holes on a circle or none, and perhaps a key that fixes the turn.

    Returns:
        The part; how many parts of a turn about z take it to itself, 0 for any, without the key; and the key.
    """
    radius, thick, boss = 1.0, rng.uniform(0.06, 0.3), rng.uniform(0.3, 0.55)
    height, bore = rng.uniform(0.15, 0.8), rng.uniform(0.4, 0.8) * boss
    up = np.eye(3)
    solids = [
        Solid("cylinder", np.zeros(3), np.array([radius, radius, thick]), up),
        Solid("cylinder", np.array([0, 0, thick + height / 2]), np.array([boss, boss, height]), up),
    ]
    holes = [Solid("cylinder", np.zeros(3), np.array([bore, bore, 9.0]), up)]
    bolts = int(rng.choice([0, 3, 4, 6, 8]))
    circle, size = (boss + radius) / 2, rng.uniform(0.15, 0.3) * (radius - boss)
    for angle in 2 * np.pi * np.arange(bolts) / max(bolts, 1):
        centre = circle * np.array([np.cos(angle), np.sin(angle), 0])
        holes.append(Solid("cylinder", centre, np.array([size, size, 2 * thick]), up))
    key = None
    if rng.random() < 0.5:
        angle = rng.uniform(0, 2 * np.pi)
        axes = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        half = np.array([rng.uniform(0.15, 0.4), rng.uniform(0.08, 0.2), thick + rng.uniform(0.05, 0.3)])
        key = Solid("box", axes[:, 0] * radius, half, axes)
        if rng.random() < 0.5:
            solids.append(key)
        else:
            holes.append(Solid("box", key.centre, half * (1, 1, 3), axes))
    return Drilled(tuple(solids), tuple(holes)), bolts, key
