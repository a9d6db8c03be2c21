"""Clouds as surfaces: normals, nearest points, and what a transform lays on what."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.surfaces import SAME_SURFACE, TOUCHING, Surface, Surfaces, nearest_within, spacing_of
from motions import move, rigid
from solids import ball, bumpy, distances, shell, spacing_by_definition

POSE = rigid([0.5, -1.2, 0.7], [0.3, -2.0, 1.0])
DISTANCE = 0.1


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


# --- one surface ---------------------------------------------------------------------------------------------------


def test_points_stay_as_they_are_and_in_order() -> None:
    points = shell(300, 1)
    np.testing.assert_array_equal(Surface.of(points).points, points)


def test_normals_of_a_plane_and_of_a_sphere(random: np.random.Generator) -> None:
    flat = Surface.of(random.uniform(size=(200, 3)) * [1, 1, 0])
    np.testing.assert_allclose(np.abs(flat.normals), np.tile([0.0, 0.0, 1.0], (200, 1)), atol=1e-6)
    round_ = Surface.of(ball(2000, 1))
    np.testing.assert_allclose(np.linalg.norm(round_.normals, axis=1), 1.0, atol=1e-6)
    assert np.abs((round_.normals * round_.points).sum(1)).min() > 0.95


def test_nearest_is_that_of_brute_force(random: np.random.Generator) -> None:
    surface, points = Surface.of(shell(400, 1)), random.normal(size=(100, 3))
    distance, row = surface.nearest(points)
    expected = distances(points, surface.points)
    np.testing.assert_array_equal(row, expected.argmin(1))
    np.testing.assert_allclose(distance, expected.min(1), rtol=1e-12)


def test_few_points_have_a_surface_too() -> None:
    points = shell(5, 1)
    assert np.isfinite(Surface.of(points).normals).all()


# --- two -----------------------------------------------------------------------------------------------------------


def pair(source: np.ndarray, target: np.ndarray) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), DISTANCE)


@pytest.fixture
def overlapping(random: np.random.Generator) -> Surfaces:
    """Two parts of one surface that share 150 points, the second moved and noisy."""
    points = shell(500, 2)
    return pair(points[:350], move(POSE, points[200:]) + random.normal(scale=0.04, size=(300, 3)))


@pytest.mark.parametrize("matrix", [POSE, POSE @ np.diag([-1.0, -1.0, 1.0, 1.0]), np.eye(4)])
@pytest.mark.parametrize("reach", [0.5, TOUCHING, 4.0])
def test_what_touches_is_what_brute_force_finds(overlapping: Surfaces, matrix: np.ndarray, reach: float) -> None:
    source, target = overlapping.source, overlapping.target
    distance = distances(move(matrix, source.points), target.points)
    rows = np.flatnonzero(distance.min(1) <= reach * DISTANCE)
    found, mine, theirs = overlapping.touching(matrix, reach)
    np.testing.assert_array_equal(mine, rows)
    np.testing.assert_array_equal(theirs, distance.argmin(1)[rows])
    np.testing.assert_allclose(found, distance.min(1)[rows], rtol=1e-9, atol=1e-12)
    cosine = np.abs(((source.normals @ matrix[:3, :3].T)[mine] * target.normals[theirs]).sum(1))
    same = cosine >= SAME_SURFACE
    for one, expected in zip(overlapping.alike(matrix, reach), (mine[same], theirs[same]), strict=True):
        np.testing.assert_array_equal(one, expected)


def test_normals_agree_up_to_their_sign_and_45_degrees(random: np.random.Generator) -> None:
    def flat(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).uniform(-1, 1, size=(800, 3)) * [1, 1, 0]

    clouds = pair(flat(1), flat(2))
    for degrees, agrees in ((0, True), (40, True), (50, False), (90, False), (180, True)):
        turned = rigid([np.radians(degrees), 0, 0], [0, 0, 0])
        mine, _ = clouds.alike(turned, 1.0)
        touching = clouds.touching(turned, 1.0)[1]
        assert len(touching) > 30
        assert (len(mine) > 0.9 * len(touching)) if agrees else (len(mine) < 0.1 * len(touching))


def test_identical_clouds_touch_themselves_in_any_order(random: np.random.Generator) -> None:
    points, order = bumpy(500, 1), random.permutation(500)
    _, rows, columns = pair(points, move(POSE, points[order])).touching(POSE)
    np.testing.assert_array_equal(rows, np.arange(500))
    np.testing.assert_array_equal(order[columns], rows)


def test_disjoint_clouds_do_not_touch() -> None:
    away = rigid([0, 0, 0], [5.0, 0, 0])
    clouds = pair(shell(300, 1), shell(300, 2))
    assert all(len(part) == 0 for part in (*clouds.touching(away), *clouds.alike(away)))


def test_swapped_exchanges_the_surfaces(overlapping: Surfaces) -> None:
    other = overlapping.swapped
    assert other.source is overlapping.target
    assert other.target is overlapping.source
    assert other.spacing == overlapping.spacing


# --- spacing and inliers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [31, 301, 1500])
def test_spacing_is_the_median_distance_of_neighbours(count: int) -> None:
    points = shell(count, 1)
    tolerance = 1e-9 if count < 1000 else 0.05  # of many points, some are asked
    assert spacing_of(points) == pytest.approx(spacing_by_definition(points), rel=tolerance)


def test_spacing_of_many_points_is_that_of_some_all_over_the_cloud() -> None:
    # a third of the points lie three times as far apart
    dense, sparse = shell(4000, 1), 3 * shell(2000, 2)
    for away in (-9.0, 9.0):
        cloud = np.vstack([dense, sparse + np.array([away, 0, 0])])
        shuffled = np.random.default_rng(0).permutation(cloud)
        assert spacing_of(cloud) == pytest.approx(spacing_of(shuffled), rel=0.1)


def test_copies_of_points_do_not_count() -> None:
    points = np.repeat(shell(50, 1), [1] * 30 + [2] * 20, axis=0)
    assert spacing_of(points) == pytest.approx(spacing_by_definition(shell(50, 1)), rel=0.2)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
def test_nearest_within_is_that_of_brute_force(random: np.random.Generator, unit: float) -> None:
    source, target = unit * random.uniform(size=(80, 3)), unit * random.uniform(size=(60, 3))
    place = unit * np.array([5e5, 5.6e6, 100.0])
    pairs, misses = nearest_within(source + place, target + place, unit * DISTANCE)
    distance = distances(source, target)
    rows = np.flatnonzero(distance.min(1) <= unit * DISTANCE)
    assert 5 < len(rows) < 75
    assert pairs.dtype == np.int64
    np.testing.assert_array_equal(pairs, np.stack([rows, distance.argmin(1)[rows]], 1))
    np.testing.assert_allclose(misses, distance.min(1)[rows], rtol=1e-6)


def test_nothing_within_reach(random: np.random.Generator) -> None:
    pairs, misses = nearest_within(random.uniform(size=(80, 3)), random.uniform(size=(60, 3)) + 9, DISTANCE)
    assert pairs.shape == (0, 2)
    assert misses.shape == (0,)


@pytest.mark.parametrize("far", [1e9, 1e99])
def test_a_stray_point_is_no_inlier_and_hides_none(random: np.random.Generator, far: float) -> None:
    source, target = random.uniform(size=(80, 3)), random.uniform(size=(60, 3))
    pairs, _ = nearest_within(source, target, DISTANCE)
    strayed, _ = nearest_within(np.vstack([source, [[far, 0, 0]]]), np.vstack([target, [[0, -far, 0]]]), DISTANCE)
    np.testing.assert_array_equal(strayed, pairs)
