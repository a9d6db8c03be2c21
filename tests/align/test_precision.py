"""What more points are worth."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.align.polish import polish
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.clouds.voxels import downsample
from idam.rigid import Array

TRUTH = rigid.exp(np.array([0.4, -0.3, 0.2, 0.1, 0.2, -0.3]))


def corner(rng: np.random.Generator, count: int) -> Array:
    points = rng.uniform(-0.7, 0.7, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = -0.7
    return points + 0.005 * rng.normal(size=points.shape)


def error(count: int, seed: int) -> float:
    """Working units by which the transform is off."""
    rng = np.random.default_rng(seed)
    source, target = corner(rng, count), rigid.apply(TRUTH, corner(rng, count))
    thinned = [downsample(points, 0.03) for points in (source, target)]
    surfaces = Surfaces(*(Surface.of(points) for points in thinned), max(spacing_of(points) for points in thinned))
    start = TRUTH @ rigid.exp(rng.normal(scale=0.003, size=6))
    found, _ = polish(surfaces, start, lambda: (source, target))
    return float(np.linalg.norm(rigid.log(rigid.inverse(found) @ TRUTH)))


def test_error_falls_with_the_number_of_points() -> None:
    few, many = (np.sqrt(np.mean([error(count, seed) ** 2 for seed in range(3)])) for count in (6_000, 60_000))
    assert many < 0.7 * few
