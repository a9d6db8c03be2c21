"""Clouds sampled from surfaces, written out in NumPy."""

from collections.abc import Callable

import numpy as np

from idam import rigid

Points = np.ndarray


def sphere(rng: np.random.Generator, count: int) -> Points:
    points = rng.standard_normal((count, 3))
    return 0.6 * points / np.linalg.norm(points, axis=1, keepdims=True)


def torus(rng: np.random.Generator, count: int) -> Points:
    a, b = rng.uniform(0, 2 * np.pi, (2, count))
    ring = 0.7 + 0.25 * np.cos(b)
    return np.stack([ring * np.cos(a), ring * np.sin(a), 0.25 * np.sin(b)], 1)


def box(rng: np.random.Generator, count: int, size: tuple[float, ...] = (1.0, 0.8, 0.6)) -> Points:
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(3, size=count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size


def plate(rng: np.random.Generator, count: int) -> Points:
    """Opposite faces within reach of each other: many pairs of parallel normals."""
    return box(rng, count, (1.2, 0.9, 0.1))


SHAPES: dict[str, Callable[[np.random.Generator, int], Points]] = {
    "sphere": sphere,
    "torus": torus,
    "box": box,
    "plate": plate,
}


def make_cloud(shape: str, count: int = 768, noise: float = 0.0) -> Points:
    rng = np.random.default_rng(0)
    return SHAPES[shape](rng, count) + noise * rng.standard_normal((count, 3))


def blob(count: int) -> Points:
    """A bumpy surface without symmetry."""
    points = sphere(np.random.default_rng(0), count)
    return points * (1 + 0.3 * np.sin(points @ [[5.0], [3.0], [1.0]]) + 0.2 * np.cos(points @ [[-1.0], [4.0], [6.0]]))


MOTION = rigid.transform(rigid.rotation_exp(np.array([1.1, -2.0, 0.7])), [0.3, -0.2, 0.5])


def moved(points: Points) -> Points:
    return rigid.apply(MOTION, points)


def degenerate_clouds() -> dict[str, Points]:
    uniform = np.random.default_rng(0).random((300, 3))
    return {
        "one place": np.ones((300, 3)),
        "line": uniform[:, :1] * (0.3, 0.5, 0.8),
        "axis-parallel line": uniform * (1.0, 0, 0),
        "plane": uniform * (1.0, 1.0, 0),
        "lattice": np.stack(np.meshgrid(*3 * [np.arange(6) / 10]), -1).reshape(-1, 3),
        "duplicates": np.tile(uniform[:20], (15, 1)),
        "two places": np.tile(uniform[:2], (100, 1)),
        "nearly duplicates": np.concatenate([uniform[:100] * 1e-21, uniform[:100]]),
        "nothing within reach": 100 * uniform,
        "far away": uniform + 1e4,
        "two points": uniform[:2],
        "three points": uniform[:3],
    }
