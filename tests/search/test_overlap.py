"""How much of two clouds a transform moves onto each other."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.surfaces import SAME_SURFACE, TOUCHING, Surface, Surfaces
from idam.search.overlap import overlap
from motions import move, rigid
from solids import distances, shell

POSE = rigid([0.5, -1.2, 0.7], [0.3, -2.0, 1.0])
SPACING = 0.06


def pair(source: np.ndarray, target: np.ndarray) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), SPACING)


@pytest.fixture
def overlapping() -> Surfaces:
    """Two parts of one surface that share 150 points, the second moved and noisy."""
    points = shell(500, 2)
    noise = np.random.default_rng(0).normal(scale=0.04, size=(300, 3))
    return pair(points[:350], move(POSE, points[200:]) + noise)


def test_identical_clouds_overlap_wholly() -> None:
    points = shell(300, 1)
    assert overlap(pair(points, move(POSE, points)), POSE) == 1.0
    assert overlap(pair(points, points), np.eye(4)) == 1.0


def test_disjoint_clouds_do_not_overlap() -> None:
    assert overlap(pair(shell(300, 1), shell(300, 1)), rigid([0, 0, 0], [5.0, 0, 0])) == 0.0


@pytest.mark.parametrize("matrix", [POSE, POSE @ np.diag([-1.0, -1.0, 1.0, 1.0])])
def test_is_that_of_brute_force(overlapping: Surfaces, matrix: np.ndarray) -> None:
    source, target = overlapping.source, overlapping.target
    distance = distances(move(matrix, source.points), target.points)
    alike = np.abs(source.normals @ matrix[:3, :3].T @ target.normals.T) >= SAME_SURFACE
    shares = [
        ((d.min(1) <= TOUCHING * SPACING) & a[np.arange(len(d)), d.argmin(1)]).mean()
        for d, a in ((distance, alike), (distance.T, alike.T))
    ]
    assert overlap(overlapping, matrix) == pytest.approx(np.sqrt(np.prod(shares)), abs=1e-12)


def test_swapping_the_clouds_changes_nothing(overlapping: Surfaces) -> None:
    forth = overlap(overlapping, POSE)
    assert overlap(overlapping.swapped(), np.linalg.inv(POSE)) == pytest.approx(forth, abs=1e-12)
    assert 0.2 < forth < 0.9


def test_is_the_mean_of_the_shares_of_points_in_the_overlap() -> None:
    points = shell(500, 1)
    # normals of the parts differ at their borders, where points of both are few
    found = overlap(pair(points[:400], points[300:]), np.eye(4), reach=1e-6)
    assert found == pytest.approx((100 / 400 * 100 / 200) ** 0.5, rel=0.15)


def test_falls_as_the_clouds_part() -> None:
    clouds = pair(shell(500, 1), shell(500, 1))
    found = [overlap(clouds, rigid([0, 0, 0], [shift] * 3)) for shift in (0.0, 0.065, 0.13, 0.3, 1.5)]
    assert found == sorted(found, reverse=True)
    assert len(set(found)) == len(found)


def test_surfaces_that_cross_do_not_overlap() -> None:
    random = np.random.default_rng(0)
    plane, other = (random.uniform(-1, 1, size=(800, 3)) * [1, 1, 0] for _ in range(2))
    clouds = pair(plane, move(POSE, other))
    assert overlap(clouds, POSE, reach=4.0) > 0.98
    assert overlap(clouds, POSE @ rigid([np.pi / 2, 0, 0], [0, 0, 0]), reach=4.0) < 0.1
