"""How well a transform explains two clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from idam.align import Refinable
from idam.search.overlap import SAME_SURFACE, Agreement, agreement, inliers, touching

DISTANCE = 0.1


@dataclass
class Surface:
    """Points with normals of our own choice, in place of a Refinable."""

    points: np.ndarray
    normals: np.ndarray

    @property
    def search(self) -> cKDTree:
        return cKDTree(self.points)


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def sphere(random: np.random.Generator) -> Surface:
    normals = random.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(normals * [1.0, 0.8, 0.6], normals)


@pytest.fixture
def transformation() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0.5, -1.2, 0.7]).as_matrix()
    matrix[:3, 3] = [0.3, -2.0, 1.0]
    return matrix


def moved(surface: Surface, transformation: np.ndarray) -> Surface:
    rotation, translation = transformation[:3, :3], transformation[:3, 3]
    return Surface(surface.points @ rotation.T + translation, surface.normals @ rotation.T)


def part(surface: Surface, rows: slice) -> Surface:
    return Surface(surface.points[rows], surface.normals[rows])


def test_identical_clouds_agree_wholly(sphere: Surface, transformation: np.ndarray) -> None:
    assert agreement(sphere, moved(sphere, transformation), transformation, DISTANCE) == Agreement(1.0, 1.0)
    assert agreement(sphere, sphere, np.eye(4), DISTANCE).score == 1.0


def test_disjoint_clouds_do_not_agree(sphere: Surface) -> None:
    away = np.eye(4)
    away[0, 3] = 5.0
    assert agreement(sphere, sphere, away, DISTANCE) == Agreement(0.0, 0.0)
    assert agreement(sphere, sphere, away, DISTANCE).score == 0.0


def overlapping(sphere: Surface, transformation: np.ndarray, random: np.random.Generator) -> tuple[Surface, Surface]:
    """Two parts of a sphere that share 150 points, the second moved and noisy."""
    target = moved(part(sphere, slice(200, 500)), transformation)
    noisy = target.points + random.normal(scale=0.04, size=(300, 3))
    return part(sphere, slice(0, 350)), Surface(noisy, target.normals)


def test_swapping_the_clouds_swaps_the_shares(
    sphere: Surface, transformation: np.ndarray, random: np.random.Generator
) -> None:
    source, target = overlapping(sphere, transformation, random)
    there = agreement(source, target, transformation, DISTANCE)
    back = agreement(target, source, np.linalg.inv(transformation), DISTANCE)
    assert (there.source_share, there.target_share) == (back.target_share, back.source_share)
    assert there.score == back.score
    assert 0.3 < there.target_share < 0.9


def test_shares_are_those_of_brute_force(
    sphere: Surface, transformation: np.ndarray, random: np.random.Generator
) -> None:
    source, target = overlapping(sphere, transformation, random)
    there = moved(source, transformation)
    distance = cdist(there.points, target.points)
    alike = np.abs(there.normals @ target.normals.T) >= SAME_SURFACE
    on_target, on_source = (
        (d.min(1) < DISTANCE) & a[np.arange(len(d)), d.argmin(1)] for d, a in ((distance, alike), (distance.T, alike.T))
    )
    expected = Agreement(on_target.mean(), on_source.mean())
    assert agreement(source, target, transformation, DISTANCE) == expected


def test_shares_are_those_of_the_points_in_the_overlap(sphere: Surface) -> None:
    found = agreement(part(sphere, slice(0, 400)), part(sphere, slice(300, 500)), np.eye(4), 1e-6)
    assert found == Agreement(100 / 400, 100 / 200)
    assert found.score == pytest.approx((0.25 * 0.5) ** 0.5)


@pytest.mark.parametrize(("degrees", "same"), [(0, True), (40, True), (50, False), (90, False), (140, True)])
def test_normals_count_up_to_their_sign(sphere: Surface, degrees: float, same: bool) -> None:
    across = np.cross(sphere.normals, [0.6, 0.0, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    turned = np.cos(np.radians(degrees)) * sphere.normals + np.sin(np.radians(degrees)) * across
    other = Surface(sphere.points, turned)
    # so close that each point finds itself
    assert agreement(sphere, other, np.eye(4), 1e-6).score == float(same)


def test_wrong_normals_take_from_the_score(sphere: Surface, random: np.random.Generator) -> None:
    wrong = sphere.normals.copy()
    wrong[:100] = np.cross(wrong[:100], random.normal(size=3))
    wrong[:100] /= np.linalg.norm(wrong[:100], axis=1, keepdims=True)
    assert agreement(sphere, Surface(sphere.points, wrong), np.eye(4), 1e-6) == Agreement(0.8, 0.8)


def test_falls_as_the_clouds_part(sphere: Surface) -> None:
    scores = []
    for shift in (0.0, 0.065, 0.13, 0.3, 1.5):
        away = np.eye(4)
        away[:3, 3] = shift
        scores.append(agreement(sphere, sphere, away, DISTANCE).score)
    assert scores == sorted(scores, reverse=True)
    assert len(set(scores)) == len(scores)


def test_takes_the_normals_that_refinement_estimates(transformation: np.ndarray, random: np.random.Generator) -> None:
    plane, other = (random.uniform(-1, 1, size=(800, 3)) * [1, 1, 0] for _ in range(2))
    target = Refinable.build(other @ transformation[:3, :3].T + transformation[:3, 3])
    assert agreement(Refinable.build(plane), target, transformation, 0.2).score > 0.98
    upright = transformation.copy()
    upright[:3, :3] = transformation[:3, :3] @ Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()
    assert agreement(Refinable.build(plane), target, upright, 0.2).score < 0.05


# --- points that touch ---------------------------------------------------------------------------------------------


def laid_on_one_by_one(source: Surface, target: Surface, transformation: np.ndarray) -> list[tuple[int, int]]:
    there = moved(source, transformation)
    pairs = []
    for i, (point, normal) in enumerate(zip(there.points, there.normals, strict=True)):
        distance = [float(np.linalg.norm(point - other)) for other in target.points]
        j = int(np.argmin(distance))
        if distance[j] < DISTANCE and abs(normal @ target.normals[j]) >= SAME_SURFACE:
            pairs.append((i, j))
    return pairs


def test_points_that_touch_are_those_found_one_by_one(
    sphere: Surface, transformation: np.ndarray, random: np.random.Generator
) -> None:
    source, target = overlapping(sphere, transformation, random)
    target.normals[:50] = np.cross(target.normals[:50], [0.6, 0.0, 0.8])
    for matrix in (transformation, transformation @ np.diag([-1.0, -1.0, 1.0, 1.0])):
        rows, columns = touching(source, target, matrix, DISTANCE)
        assert rows.dtype == columns.dtype == np.int64
        pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
        assert pairs == laid_on_one_by_one(source, target, matrix)
        assert 20 < len(pairs) < 330
        assert len(pairs) / 350 == agreement(source, target, matrix, DISTANCE).source_share


def test_points_of_identical_clouds_touch_themselves(sphere: Surface, transformation: np.ndarray) -> None:
    order = np.random.default_rng(1).permutation(500)
    there = moved(sphere, transformation)
    rows, columns = touching(sphere, Surface(there.points[order], there.normals[order]), transformation, DISTANCE)
    np.testing.assert_array_equal(rows, np.arange(500))
    np.testing.assert_array_equal(order[columns], rows)


def test_nothing_of_disjoint_clouds_touches(sphere: Surface) -> None:
    away = np.eye(4)
    away[0, 3] = 5.0
    rows, columns = touching(sphere, sphere, away, DISTANCE)
    assert rows.shape == columns.shape == (0,)


# --- inliers -------------------------------------------------------------------------------------------------------


def test_inliers_are_those_of_brute_force(random: np.random.Generator) -> None:
    source, target = random.uniform(size=(80, 3)), random.uniform(size=(60, 3))
    pairs, rmse = inliers(source, target, DISTANCE)
    distance = cdist(source, target)
    rows = np.flatnonzero(distance.min(1) < DISTANCE)
    assert 5 < len(rows) < 75
    assert pairs.dtype == np.int64
    np.testing.assert_array_equal(pairs, np.stack([rows, distance.argmin(1)[rows]], 1))
    assert rmse == pytest.approx(np.sqrt(np.mean(distance.min(1)[rows] ** 2)))


def test_no_inliers(random: np.random.Generator) -> None:
    pairs, rmse = inliers(random.uniform(size=(80, 3)), random.uniform(size=(60, 3)) + 9, DISTANCE)
    assert pairs.shape == (0, 2)
    assert pairs.dtype == np.int64
    assert rmse == 0.0


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
def test_inliers_in_any_unit_place_and_order(random: np.random.Generator, unit: float) -> None:
    source, target = random.uniform(size=(300, 3)), random.uniform(size=(200, 3))
    pairs, rmse = inliers(source, target, DISTANCE)
    place = unit * np.array([5e5, 5.6e6, 100.0])
    there, there_rmse = inliers(unit * source + place, unit * target + place, unit * DISTANCE)
    np.testing.assert_array_equal(there, pairs)
    assert there_rmse == pytest.approx(unit * rmse, rel=1e-6)
    rows = random.permutation(len(source))
    shuffled, _ = inliers(source[rows], target, DISTANCE)
    np.testing.assert_array_equal(shuffled[np.argsort(rows[shuffled[:, 0]]), 1], pairs[:, 1])


@pytest.mark.parametrize("far", [1e9, 1e99])
def test_a_stray_point_is_no_inlier_and_hides_none(random: np.random.Generator, far: float) -> None:
    source, target = random.uniform(size=(80, 3)), random.uniform(size=(60, 3))
    pairs, _ = inliers(source, target, DISTANCE)
    strayed, _ = inliers(np.vstack([source, [[far, 0, 0]]]), np.vstack([target, [[0, -far, 0]]]), DISTANCE)
    np.testing.assert_array_equal(strayed, pairs)


@pytest.mark.parametrize("distance", [1e-150, 1e-12, 100.0, 1e150])
def test_inliers_at_any_distance(random: np.random.Generator, distance: float) -> None:
    points = random.uniform(size=(80, 3))
    pairs, rmse = inliers(points, points, distance)
    np.testing.assert_array_equal(pairs, np.stack([np.arange(80)] * 2, 1))
    assert rmse == 0.0


def test_a_distance_too_small_to_square_finds_nothing_and_warns_of_nothing(random: np.random.Generator) -> None:
    points = random.uniform(size=(80, 3))
    assert inliers(points, points, 1e-320)[0].shape == (0, 2)
