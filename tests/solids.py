"""Points on solids that several tests register, sampled evenly."""

from __future__ import annotations

import numpy as np

Corners = list[tuple[list[float], list[float]]]

BRACKET: Corners = [
    ([0, 0, 0], [1, 0.5, 0.12]),
    ([0, 0, 0.12], [0.15, 0.5, 0.82]),
    ([0.55, 0.1, 0.12], [0.8, 0.3, 0.47]),
    ([0.8, 0.35, 0.12], [0.9, 0.45, 0.27]),
]
"""Lowest and highest corners of the boxes of a part without symmetry, about one unit long."""


def boxes(corners: Corners, count: int, seed: int) -> np.ndarray:
    """Points (count, 3) on the faces of boxes."""
    random = np.random.default_rng(seed)
    low, size = np.array([c[0] for c in corners], float), np.array([np.subtract(c[1], c[0]) for c in corners])
    area = np.repeat(np.stack([size[:, 1] * size[:, 2], size[:, 2] * size[:, 0], size[:, 0] * size[:, 1]], 1), 2, 1)
    face = random.choice(area.size, count, p=(area / area.sum()).ravel())
    box, face = np.divmod(face, 6)
    at = random.uniform(size=(count, 3))
    at[np.arange(count), face // 2] = face % 2
    points: np.ndarray = low[box] + at * size[box]
    return points


def box(size: tuple[float, float, float], count: int, seed: int) -> np.ndarray:
    """Points on one box about the origin."""
    half = np.array(size) / 2
    return boxes([((-half).tolist(), half.tolist())], count, seed)


def bracket(count: int, seed: int) -> np.ndarray:
    """Points on a part without symmetry, about one unit long."""
    return boxes(BRACKET, count, seed)


def ball(count: int, seed: int) -> np.ndarray:
    """Points on the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    normalised: np.ndarray = points / np.linalg.norm(points, axis=1, keepdims=True)
    return normalised


def shell(count: int, seed: int) -> np.ndarray:
    """Points on an ellipsoid that fits the unit sphere."""
    return ball(count, seed) * [0.9, 0.6, 0.5]


def torus(count: int, seed: int, large: float = 1.0, small: float = 0.4) -> np.ndarray:
    """Points on a torus about z, denser on its inside."""
    around, across = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, count))
    radius = large + small * np.cos(across)
    return np.stack([radius * np.cos(around), radius * np.sin(around), small * np.sin(across)], 1)


def bumpy(count: int, seed: int) -> np.ndarray:
    """Points on a closed surface without symmetry."""
    points = ball(count, seed)
    waves = np.sin(5 * points @ np.array([0.6, 0.0, 0.8])) + np.cos(4 * points @ np.array([0.0, 1.0, 0.3]))
    bumps: np.ndarray = points * [1.0, 0.6, 0.4] * (0.8 + 0.15 * waves[:, None]) + 0.2 * np.maximum(points, 0)
    return bumps


def potato(count: int, seed: int) -> np.ndarray:
    """Points all over a lumpy closed surface."""
    direction = ball(count, seed)
    x, y, z = direction.T
    radius = 0.7 + 0.15 * np.sin(3 * x + 1) * y + 0.1 * np.cos(4 * z) * x + 0.15 * z**2
    return np.asarray(radius[:, None] * direction * [1.0, 0.7, 0.5])


def noise(count: int, seed: int) -> np.ndarray:
    """Points that lie on no surface."""
    return np.random.default_rng(seed).normal(size=(count, 3))


def spacing_by_definition(points: np.ndarray) -> float:
    """The median distance of a point to its nearest neighbour."""
    distance = distances(points, points)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(1)))


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The distance (N, M) of each of the points a (N, 3) to each of the points b (M, 3)."""
    return np.linalg.norm(a[:, None] - b, axis=-1)
