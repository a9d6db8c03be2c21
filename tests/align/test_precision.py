"""What more points are worth."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.align.patches import Pairs
from idam.align.polish import polish
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.clouds.voxels import downsample
from idam.rigid import Array

VOXEL = 0.03
TRUTH = rigid.exp(np.array([0.4, -0.3, 0.2, 0.1, 0.2, -0.3]))


def corner(rng: np.random.Generator, count: int, noise: float = 0.005, place: float = -0.7) -> Array:
    points = rng.uniform(-0.7, 0.7, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = place
    return points + noise * rng.normal(size=points.shape)


def polished(source: Array, target: Array, seed: int) -> tuple[Array, Pairs]:
    thinned = [downsample(points, VOXEL) for points in (source, target)]
    surfaces = Surfaces(*(Surface.of(points) for points in thinned), max(spacing_of(points) for points in thinned))
    start = TRUTH @ rigid.exp(np.random.default_rng(seed).normal(scale=0.003, size=6))
    return polish(surfaces, start, lambda: (source, target))


def error(count: int, seed: int) -> float:
    """Working units by which the transform is off."""
    rng = np.random.default_rng(seed)
    found, _ = polished(corner(rng, count), rigid.apply(TRUTH, corner(rng, count)), seed)
    return float(np.linalg.norm(rigid.log(rigid.inverse(found) @ TRUTH)))


def test_error_falls_with_the_number_of_points() -> None:
    few, many = (np.sqrt(np.mean([error(count, seed) ** 2 for seed in range(3)])) for count in (6_000, 60_000))
    assert many < 0.7 * few


def test_walls_in_the_faces_of_voxels_do_not_draw_the_answer() -> None:
    """A few points of a wall that noise takes into the next voxels must not weigh as much as all the others."""
    noise = 0.0005
    for seed in range(2):
        rng = np.random.default_rng(seed)
        source = corner(rng, 60_000, noise, place=-20 * VOXEL - noise)
        found, _ = polished(source, rigid.apply(TRUTH, corner(rng, 60_000, noise, place=-20 * VOXEL - noise)), seed)
        shift = rigid.log(rigid.inverse(found) @ TRUTH)[3:]
        assert np.abs(shift).max() < 0.3 * noise


def test_patches_that_follow_the_noise_hold_less() -> None:
    """Where noise is as thick as patches, they follow the place they are asked at, and say so."""
    rng = np.random.default_rng(0)
    _, thick = polished(corner(rng, 30_000, 0.02), rigid.apply(TRUTH, corner(rng, 30_000, 0.02)), 0)
    _, thin = polished(corner(rng, 30_000, 0.0005), rigid.apply(TRUTH, corner(rng, 30_000, 0.0005)), 0)
    assert thick.response < 0.85
    assert thin.response == 1.0
