"""Shapes of our own making: random mechanical parts, and partial views of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["View", "partial_views", "random_part", "sample_surface"]

Points = NDArray[np.float64]


def random_part(rng: np.random.Generator) -> Any:
    """A part of three to eight primitives around a base, as a trimesh mesh about as large as the unit sphere."""
    import trimesh

    pieces = [trimesh.creation.box(rng.uniform(0.3, 1.4, 3))]
    for _ in range(rng.integers(2, 8)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-0.5, 0.5, 3)
        pieces.append(_primitive(rng).apply_transform(pose))
    part: Any = trimesh.util.concatenate(pieces)
    return part.apply_translation(-part.centroid).apply_scale(1.0 / np.linalg.norm(part.vertices, axis=1).max())


def _primitive(rng: np.random.Generator) -> Any:
    import trimesh

    a, b, c = rng.uniform(0.1, 0.5, 3)
    kind = rng.integers(5)
    if kind == 0:
        return trimesh.creation.box((2 * a, 2 * b, 2 * c))
    if kind == 1:
        return trimesh.creation.cylinder(a / 1.5, 2 * b, sections=48)
    if kind == 2:
        return trimesh.creation.icosphere(3, a)
    if kind == 3:
        return trimesh.creation.cone(a, 2 * b, sections=48)
    return trimesh.creation.torus(a, a / 3, major_sections=48, minor_sections=24)


def sample_surface(mesh: Any, count: int, rng: np.random.Generator) -> Points:
    """``count`` points (count, 3) uniformly on the surface of a trimesh mesh."""
    import trimesh

    points, _ = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    return np.asarray(points)


@dataclass(frozen=True)
class View:
    """Two views of one object: source (N, 3), target (P, 3), and the truth (4, 4), target = T source."""

    source: Points
    target: Points
    transformation: Points


def partial_views(mesh: Any, rng: np.random.Generator, points: int, keep: float, noise: float) -> View:
    """Two views sampled independently, each cropped by its own half-space, the target anywhere in SO(3).

    Args:
        mesh: a trimesh mesh about as large as the unit sphere.
        rng: random numbers.
        points: of each view, before cropping.
        keep: share of the points that stay on the kept side; 2 keep - 1 of the surface is the least overlap.
        noise: sigma of the Gaussian noise on every coordinate.
    """
    truth = np.eye(4)
    truth[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    truth[:3, 3] = rng.uniform(-1, 1, 3)
    views = []
    for _ in range(2):
        surface = sample_surface(mesh, points, rng)
        along = surface @ rng.normal(size=3)
        views.append(surface[along <= np.quantile(along, keep)])
    source, target = (view + rng.normal(scale=noise, size=view.shape) for view in views)
    return View(source, target @ truth[:3, :3].T + truth[:3, 3], truth)
