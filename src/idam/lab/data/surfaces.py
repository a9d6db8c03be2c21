"""Surfaces of our own making, as dense points: single objects, rooms, streets; each drawn from a generator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from idam.lab.data.parts import random_part, sample_surface

__all__ = ["random_blob", "random_object", "random_room", "random_street"]

Points = NDArray[np.float64]

MESHES, PARTS = 0.5, 0.25
"""Shares of objects that are warped meshes, where there are any, and parts; the others are blobs."""
CORE = 0.98
"""Share of an object's points that lie in the unit sphere."""
PLACES = 8
"""Viewpoints that come with a room or a street."""


def random_object(count: int, rng: np.random.Generator, meshes: Sequence[Any] = ()) -> Points:
    """A single object (count, 3), about as large as the unit sphere: a warped mesh, a mechanical part or a blob.

    Args:
        count: of points.
        rng: random numbers.
        meshes: trimesh meshes to warp.
    """
    kind = rng.random()
    if meshes and kind < MESHES:
        points = warp(unit(sample_surface(meshes[int(rng.integers(len(meshes)))], count, rng)), rng)
    elif kind < MESHES + PARTS:
        points = sample_surface(random_part(rng), count, rng)
    else:
        points = random_blob(count, rng)
    return unit(points)


def unit(points: Points) -> Points:
    """Points (N, 3) centred and scaled."""
    centred = points - points.mean(0)
    scaled: Points = centred / np.quantile(np.linalg.norm(centred, axis=1), CORE)
    return scaled


def warp(points: Points, rng: np.random.Generator) -> Points:
    """Points (N, 3) bent by waves about as long as the object, and stretched: a mesh becomes many shapes."""
    bent = points.copy()
    for _ in range(3):
        wave = rng.normal(size=3) * rng.uniform(0.8, 2.5)
        shift = rng.normal(size=3) * rng.uniform(0, 0.08)
        bent += np.sin(points @ wave + rng.uniform(0, 2 * np.pi))[:, None] * shift
    stretched: Points = bent * np.exp(0.2 * rng.normal(size=3))
    return stretched


def random_blob(count: int, rng: np.random.Generator) -> Points:
    """A sphere (count, 3) of radius about 1 with bumps of many sizes, the finer the lower."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.ones(count)
    for _ in range(rng.integers(3, 14)):
        frequency, axis = rng.uniform(1, 9), rng.normal(size=3)
        phase = direction @ axis * (frequency / np.linalg.norm(axis)) + rng.uniform(0, 2 * np.pi)
        radius += rng.normal() * 0.5 / frequency**0.9 * np.sin(phase)
    blob: Points = direction * radius.clip(0.25)[:, None]
    return blob


def box(count: int, size: Sequence[float] | Points, rng: np.random.Generator) -> Points:
    """The six sides (count, 3) of a box about the origin, with edges of the given lengths."""
    x, y, z = size
    area = np.array([y * z, x * z, x * y])
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), rng.choice(3, count, p=area / area.sum())] = rng.choice([-1.0, 1.0], count)
    sides: Points = points * np.asarray(size) / 2
    return sides


def cylinder(count: int, radius: float, height: float, rng: np.random.Generator) -> Points:
    """The mantle (count, 3) of an upright cylinder about the origin."""
    angle = rng.uniform(0, 2 * np.pi, count)
    mantle: Points = np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-height / 2, height / 2, count)]
    return mantle


def stand(points: Points, turn: float, x: float, y: float, z: float) -> Points:
    """Points (N, 3) turned about the vertical, with their lowest at height z above (x, y)."""
    turned = points @ Rotation.from_euler("z", turn).as_matrix().T
    stood: Points = turned + np.array([x, y, z - turned[:, 2].min()])
    return stood


def random_room(count: int, rng: np.random.Generator, meshes: Sequence[Any] = ()) -> tuple[Points, Points]:
    """A room of about ``count`` points (N, 3), 1 to 2 wide, furnished; and places (8, 3) to look at it from."""
    length, width, height = rng.uniform(0.75, 2), rng.uniform(0.75, 2), rng.uniform(0.6, 1.1)
    walls = box(count // 2, (length, width, height), rng) + np.array([0, 0, height / 2])
    pieces = [walls[walls[:, 2] < height - 1e-9]]
    number = rng.integers(4, 12)
    for _ in range(number):
        points = _furniture(count // 2 // number, rng, meshes)
        base = 0.0 if rng.random() < 0.7 else rng.uniform(0, height / 2)
        x, y = rng.uniform(-0.42, 0.42, 2) * (length, width)
        pieces.append(stand(points, rng.uniform(0, 2 * np.pi), x, y, base))
    places = rng.uniform((-0.35, -0.35, 0.4), (0.35, 0.35, 0.8), (PLACES, 3)) * (length, width, height)
    return np.concatenate(pieces), places


def _furniture(count: int, rng: np.random.Generator, meshes: Sequence[Any]) -> Points:
    kind = rng.random()
    if kind < 0.45:
        return box(count, rng.uniform(0.08, 0.5, 3), rng)
    if kind < 0.6:
        return cylinder(count, rng.uniform(0.03, 0.12), rng.uniform(0.1, 0.6), rng)
    return random_object(count, rng, meshes) * rng.uniform(0.08, 0.3)


def random_street(count: int, rng: np.random.Generator) -> tuple[Points, Points]:
    """A street of about ``count`` points (N, 3), 6 long, with houses, cars, poles, trees; and places (8, 3) on it."""
    ground = np.c_[rng.uniform(-3, 3, (count // 3, 2)), np.zeros(count // 3)]
    for axis in (0, 1):
        ground[:, 2] += 0.03 * np.sin(ground[:, axis] * rng.uniform(0.3, 1.5) + rng.uniform(0, 2 * np.pi))
    pieces, half = [ground], rng.uniform(0.3, 0.8)
    number = rng.integers(10, 28)
    each = 2 * count // 3 // number
    for _ in range(number):
        kind, side = rng.random(), rng.choice([-1.0, 1.0])
        if kind < 0.35:
            points = box(each, rng.uniform((0.3, 0.2, 0.3), (1.5, 0.8, 1.2)), rng)
            y = half + rng.uniform(0.2, 1.2)
        elif kind < 0.6:
            points, y = box(each // 2, (0.22, 0.09, 0.08), rng), rng.uniform(0.1, half)
        elif kind < 0.8:
            points = cylinder(each // 3, rng.uniform(0.01, 0.03), rng.uniform(0.2, 0.6), rng)
            y = rng.uniform(0.3, half + 0.2)
        else:
            points, y = random_blob(each // 2, rng) * rng.uniform(0.08, 0.25), half + rng.uniform(0, 0.6)
        turn = 0.15 * rng.normal() + rng.choice([0, np.pi / 2], p=[0.7, 0.3])
        pieces.append(stand(points, turn, rng.uniform(-2.8, 2.8), side * y, 0.0))
    places = np.c_[np.linspace(-0.6, 0.6, PLACES), rng.uniform((-0.15, 0.06), (0.15, 0.12), (PLACES, 2))]
    return np.concatenate(pieces), places
