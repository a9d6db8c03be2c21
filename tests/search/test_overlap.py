"""How much of two clouds a transform moves onto each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idam.clouds.surfaces import SAME_SURFACE, TOUCHING, Surface, Surfaces
from idam.search.overlap import exactness, shares
from motions import move, rigid
from solids import distances, shell

POSE = rigid([0.5, -1.2, 0.7], [0.3, -2.0, 1.0])
SPACING = 0.06


def pair(source: np.ndarray, target: np.ndarray) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), SPACING)


def overlap(surfaces: Surfaces, matrix: np.ndarray) -> float:
    """The geometric mean of both shares."""
    return float(np.prod(shares(surfaces, matrix)) ** 0.5)


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
    expected = [
        ((d.min(1) <= TOUCHING * SPACING) & a[np.arange(len(d)), d.argmin(1)]).mean()
        for d, a in ((distance, alike), (distance.T, alike.T))
    ]
    assert overlap(overlapping, matrix) == pytest.approx(np.sqrt(np.prod(expected)), abs=1e-12)


def test_swapping_the_clouds_changes_nothing(overlapping: Surfaces) -> None:
    forth = overlap(overlapping, POSE)
    assert overlap(overlapping.swapped, np.linalg.inv(POSE)) == pytest.approx(forth, abs=1e-12)
    assert 0.2 < forth < 0.9


def test_is_the_mean_of_the_shares_of_points_in_the_overlap() -> None:
    points = shell(500, 1)
    # normals of the parts differ at their borders, where points of both are few
    found = overlap(replace(pair(points[:400], points[300:]), spacing=1e-8), np.eye(4))
    assert found == pytest.approx((100 / 400 * 100 / 200) ** 0.5, rel=0.15)


def test_falls_as_the_clouds_part() -> None:
    clouds = pair(shell(500, 1), shell(500, 1))
    found = [overlap(clouds, rigid([0, 0, 0], [shift] * 3)) for shift in (0.0, 0.065, 0.13, 0.3, 1.5)]
    assert found == sorted(found, reverse=True)
    assert len(set(found)) == len(found)


def test_surfaces_that_cross_do_not_overlap() -> None:
    random = np.random.default_rng(0)
    plane, other = (random.uniform(-1, 1, size=(800, 3)) * [1, 1, 0] for _ in range(2))
    clouds = replace(pair(plane, move(POSE, other)), spacing=2.7 * SPACING)
    assert overlap(clouds, POSE) > 0.98
    assert overlap(clouds, POSE @ rigid([np.pi / 2, 0, 0], [0, 0, 0])) < 0.1


# --- the shares ----------------------------------------------------------------------------------------------------


def test_shares_are_those_of_brute_force_point_by_point(overlapping: Surfaces) -> None:
    def share(own: Surface, other: Surface, matrix: np.ndarray) -> float:
        lie = 0
        for point, normal in zip(move(matrix, own.points), own.normals @ matrix[:3, :3].T, strict=True):
            distance = np.linalg.norm(other.points - point, axis=1)
            near = int(distance.argmin())
            lie += distance[near] <= TOUCHING * SPACING and abs(normal @ other.normals[near]) >= SAME_SURFACE
        return lie / len(own.points)

    mine, theirs = shares(overlapping, POSE)
    assert mine == share(overlapping.source, overlapping.target, POSE)
    assert theirs == share(overlapping.target, overlapping.source, np.linalg.inv(POSE))
    assert mine != theirs


def test_shares_swap_with_the_clouds(overlapping: Surfaces) -> None:
    assert shares(overlapping.swapped, np.linalg.inv(POSE)) == shares(overlapping, POSE)[::-1]


def test_all_of_a_part_lies_on_the_whole_and_little_of_the_whole_on_the_part() -> None:
    whole = shell(800, 1)
    part = whole[whole[:, 0] > 0.5]
    mine, theirs = shares(pair(part, whole), np.eye(4))
    assert mine > 0.9
    assert theirs < 0.4


# --- how exactly ---------------------------------------------------------------------------------------------------


def exactness_by_definition(surfaces: Surfaces, matrix: np.ndarray, reach: float) -> tuple[float, float]:
    distances_, off = [], []
    ways = ((surfaces.source, surfaces.target, matrix), (surfaces.target, surfaces.source, np.linalg.inv(matrix)))
    for own, other, way in ways:
        for point in move(way, own.points):
            gaps = other.points - point
            near = int(np.linalg.norm(gaps, axis=1).argmin())
            if np.linalg.norm(gaps[near]) <= reach:
                distances_.append(np.linalg.norm(gaps[near]))
                off.append(abs(gaps[near] @ other.normals[near]))
    if not off:
        return 0.0, 1.0
    return float(np.mean(np.array(distances_) <= TOUCHING * surfaces.spacing)), float(np.median(off)) / reach


@pytest.mark.parametrize(
    "matrix", [POSE, POSE @ rigid([0.05, 0.0, 0.0], [0.02, 0.0, 0.03]), rigid([0, 0, 0], [9, 0, 0])]
)
@pytest.mark.parametrize("reach", [0.1, 0.4])
def test_exactness_is_that_of_the_definition(overlapping: Surfaces, matrix: np.ndarray, reach: float) -> None:
    expected = exactness_by_definition(overlapping, matrix, reach)
    np.testing.assert_allclose(exactness(overlapping, matrix, reach), expected, rtol=1e-9)


def test_exactness_swaps(overlapping: Surfaces) -> None:
    back = exactness(overlapping.swapped, np.linalg.inv(POSE), 0.3)
    np.testing.assert_allclose(back, exactness(overlapping, POSE, 0.3), rtol=1e-9)


def test_clouds_come_apart_at_a_fine_resolution_where_they_only_seem_to_touch() -> None:
    points = shell(2000, 1)
    fine = Surfaces(Surface.of(points), Surface.of(shell(2000, 2)), 0.02)
    close, off = zip(*(exactness(fine, rigid([0, 0, 0], [0, 0, shift]), 0.2) for shift in (0, 0.05, 0.1)), strict=True)
    assert close[0] > close[1] > close[2]
    assert off[0] < off[1] < off[2] <= 1.0
    assert exactness(fine, rigid([0, 0, 0], [9.0, 0, 0]), 0.2) == (0.0, 1.0)
