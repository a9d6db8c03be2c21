"""Scans whose eye is known: rays cast at rooms, spheres and corridors, worked out by formula."""

from __future__ import annotations

import numpy as np

Box = tuple[list[float], list[float]]
Ball = tuple[list[float], float]

WALLS: Box = ([-2.0, -3.0, -1.0], [5.0, 1.5, 1.2])
"""Lowest and highest corner of a room around the origin, which is not its centre."""
BALLS: list[Ball] = [([2.5, -1.0, -0.2], 0.5), ([-1.0, -2.0, 0.3], 0.4)]
"""Centres and radii of what stands in it."""


def rays(count: int, seed: int = 0) -> np.ndarray:
    """Directions (count, 3), all equally likely, of length one."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def room(count: int, eye: np.ndarray | None = None, seed: int = 0, *, balls: list[Ball] | None = None) -> np.ndarray:
    """What a scanner in the room sees, (count, 3), in the room's frame."""
    eye = np.zeros(3) if eye is None else eye
    direction = rays(count, seed)
    distance = to_walls(eye, direction)
    for centre, radius in BALLS if balls is None else balls:
        distance = np.minimum(distance, to_ball(eye, direction, np.array(centre), radius))
    return np.asarray(eye + distance[:, None] * direction)


def to_walls(eye: np.ndarray, direction: np.ndarray, walls: Box = WALLS) -> np.ndarray:
    """How far rays from within a box go, (N,)."""
    low, high = np.array(walls[0]), np.array(walls[1])
    ahead = np.where(direction > 0, high - eye, low - eye)
    return np.asarray((ahead / np.where(direction == 0, 1e-12, direction)).min(1))


def to_ball(eye: np.ndarray, direction: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """How far rays go to a ball, (N,), infinite where they miss it."""
    along = direction @ (centre - eye)
    square = radius**2 - ((centre - eye) ** 2).sum() + along**2
    hit = (square > 0) & (along > 0)
    return np.where(hit, along - np.sqrt(np.where(hit, square, 0.0)), np.inf)


def corridor(eye: float, count: int, seed: int, reach: float = 12.0) -> np.ndarray:
    """What a scanner sees of an endless corridor along x, two walls and a floor, in its own frame, (count, 3)."""
    direction = rays(6 * count, seed)
    walls: Box = ([eye - 1e6, -1.2, -1.0], [eye + 1e6, 1.3, 1e6])
    points = to_walls(np.array([eye, 0.0, 0.0]), direction, walls)[:, None] * direction
    seen = (np.linalg.norm(points, axis=1) < reach) & (points[:, 2] < 1.5)
    return np.asarray(points[seen][:count])
