"""Fine alignment of few points, which two scans of one surface do not share."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from idam.align import Refinable, Surfaces, align, reaches, refine
from idam.align.symmetric import PULL
from idam.clouds.pyramid import spacing_of
from motions import move, rigid

NUDGE = rigid([0.08, -0.06, 0.05], [0.03, -0.04, 0.05])


def potato(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) all over a lumpy closed surface, in any order."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    radius = 0.7 + 0.15 * np.sin(3 * x + 1) * y + 0.1 * np.cos(4 * z) * x + 0.15 * z**2
    return radius[:, None] * direction * [1.0, 0.7, 0.5]


def off(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and distance between two transforms."""
    turn = Rotation.from_matrix(found[:3, :3].T @ truth[:3, :3]).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found[:3, 3] - truth[:3, 3]))


def scans(seed: int, noise: float = 0.0) -> tuple[Refinable, Refinable, float]:
    """Two scans of one surface without a common point, parts of it in one of them alone, and their spacing."""
    source, target = potato(500, 2 * seed), potato(500, 2 * seed + 1)
    source, target = source[source[:, 0] < 0.35], target[target[:, 1] > -0.3]
    rng = np.random.default_rng(seed)
    source, target = (x + noise * rng.normal(size=x.shape) for x in (source, target))
    return Refinable.build(source), Refinable.build(target), max(spacing_of(source), spacing_of(target))


def symmetric(source: Refinable, target: Refinable, start: np.ndarray, spacing: float) -> np.ndarray:
    for reach in reaches("symmetric"):
        start, _ = refine(source, target, start, reach * spacing, "symmetric")
    return start


def few(source: Refinable, target: Refinable, start: np.ndarray, spacing: float) -> np.ndarray:
    for reach in reaches("symmetric"):
        start, _ = align(Surfaces(source, target, spacing), start, reach, "symmetric")
    return start


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_surfaces_are_laid_on_each_other_better_than_their_points(noise: float) -> None:
    errors = []
    for seed in range(8):
        source, target, spacing = scans(seed, noise)
        found = [
            few(source, target, NUDGE, spacing),
            refine(source, target, NUDGE, 2 * spacing, "gicp")[0],
            refine(source, target, NUDGE, 2 * spacing, "point", iterations=100)[0],
        ]
        errors.append([off(transformation, np.eye(4)) for transformation in found])
    ours, gicp, point = np.mean(errors, axis=0)
    assert (ours < point).all()
    assert (ours < 1.5 * gicp).all()  # on so smooth a thing it does nearly as well
    assert ours[0] < 2.0
    assert ours[1] < 0.02


def test_noisy_copies_of_points_are_laid_on_each_other() -> None:
    points, rng = potato(600, 5), np.random.default_rng(5)
    clouds = [Refinable.build(points + 0.008 * rng.normal(size=points.shape)) for _ in range(2)]
    spacing = spacing_of(clouds[0].points)
    found = few(*clouds, NUDGE, spacing)
    again, _ = refine(*clouds, found, spacing, "point", iterations=100)
    np.testing.assert_allclose(again, found, atol=1e-5)  # the points themselves have the last word
    assert off(found, np.eye(4))[0] < off(symmetric(*clouds, NUDGE, spacing), np.eye(4))[0]


def test_clouds_that_move_move_the_answer() -> None:
    source, target, spacing = scans(3)
    moved, motion = Refinable.build(move(NUDGE, target.points)), rigid([1.0, -0.5, 0.3], [0.2, 0.1, -0.3])
    turned = Refinable.build(move(motion, source.points))
    plain = symmetric(source, moved, np.eye(4), spacing)
    start = np.linalg.inv(motion)
    np.testing.assert_allclose(symmetric(turned, moved, start, spacing) @ motion, plain, atol=1e-4)


def test_clouds_exchanged_invert_the_answer() -> None:
    source, target, spacing = scans(4)
    forth = symmetric(source, target, NUDGE, spacing)
    back = symmetric(target, source, np.linalg.inv(NUDGE), spacing)
    degrees, shift = off(back @ forth, np.eye(4))
    assert degrees < 0.1
    assert shift < 0.001


def test_what_is_aligned_stays() -> None:
    cloud = Refinable.build(potato(300, 1))
    np.testing.assert_allclose(few(cloud, cloud, np.eye(4), 0.05), np.eye(4), atol=1e-12)


def test_clouds_far_apart_keep_the_start() -> None:
    source, target, spacing = scans(2)
    far = rigid([0.1, 0.0, 0.0], [9.0, 0.0, 0.0])
    np.testing.assert_array_equal(few(source, target, far, spacing), far)


def test_a_plane_does_not_slide_away() -> None:
    rng = np.random.default_rng(0)
    source, target = (Refinable.build(rng.uniform(-1, 1, size=(300, 3)) * [1, 1, 0]) for _ in range(2))
    start = rigid([0.02, 0.03, 0.0], [0.0, 0.0, 0.03])
    found = symmetric(source, target, start, 0.06)
    assert abs(found[2, 3]) < 1e-3  # on the plane
    assert np.linalg.norm(found[:2, 3]) < 0.06  # within a spacing of where it was
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-12)


def test_what_slides_freely_rests_where_points_lie_evenly() -> None:
    rng = np.random.default_rng(1)
    source, target = (Refinable.build(rng.uniform(-1, 1, size=(500, 3)) * [1, 1, 0]) for _ in range(2))
    start = rigid([0.0, 0.0, 0.0], [0.06, -0.04, 0.0])  # a table's top, slid
    found = symmetric(source, target, start, 0.06)
    assert np.linalg.norm(found[:2, 3]) < 0.5 * np.linalg.norm(start[:2, 3])


def test_information_is_what_small_changes_cost() -> None:
    source, target, spacing = scans(1)
    _, information = refine(source, target, np.eye(4), 2 * spacing, "symmetric")
    np.testing.assert_allclose(information, information.T, atol=1e-9)
    assert (np.linalg.eigvalsh(information) > 0).all()
    # a plane: next to nothing holds a slide along it or a turn in it
    flat = Refinable.build(np.random.default_rng(0).uniform(-1, 1, size=(300, 3)) * [1, 1, 0])
    _, held = refine(flat, flat, np.eye(4), 0.1, "symmetric")
    free, firm = held[[2, 3, 4], [2, 3, 4]], held[[0, 1, 5], [0, 1, 5]]
    assert (free < 2.1 * PULL * firm[[2, 0, 0]] * [1, 3, 3]).all()
