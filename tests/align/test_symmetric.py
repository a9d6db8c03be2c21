"""Fine alignment of few points, which two scans of one surface do not share."""

from __future__ import annotations

import numpy as np
import pytest

from idam.align import align, reaches, refine
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from motions import degrees, move, rigid
from solids import potato

NUDGE = rigid([0.08, -0.06, 0.05], [0.03, -0.04, 0.05])


def off(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and distance between two transforms."""
    return degrees(found, truth), float(np.linalg.norm(found[:3, 3] - truth[:3, 3]))


def pair(source: np.ndarray, target: np.ndarray, spacing: float | None = None) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), spacing or max(spacing_of(source), spacing_of(target)))


def scans(seed: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Two scans of one surface without a common point, parts of it in one of them alone."""
    source, target = potato(500, 2 * seed), potato(500, 2 * seed + 1)
    source, target = source[source[:, 0] < 0.35], target[target[:, 1] > -0.3]
    random = np.random.default_rng(seed)
    source, target = (x + noise * random.normal(size=x.shape) for x in (source, target))
    return source, target


def symmetric(surfaces: Surfaces, start: np.ndarray) -> np.ndarray:
    for reach in reaches("symmetric"):
        start = refine(surfaces, start, reach * surfaces.spacing, "symmetric")
    return start


def few(surfaces: Surfaces, start: np.ndarray) -> np.ndarray:
    for reach in reaches("symmetric"):
        start = align(surfaces, start, reach, "symmetric")
    return start


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_surfaces_are_aligned_better_than_their_points(noise: float) -> None:
    errors = []
    for seed in range(8):
        surfaces = pair(*scans(seed, noise))
        found = [
            few(surfaces, NUDGE),
            refine(surfaces, NUDGE, 2 * surfaces.spacing, "gicp"),
            refine(surfaces, NUDGE, 2 * surfaces.spacing, "point", iterations=100),
        ]
        errors.append([off(transformation, np.eye(4)) for transformation in found])
    ours, gicp, point = np.mean(errors, axis=0)
    assert (ours < point).all()
    assert (ours < 1.5 * gicp).all()  # on so smooth a surface it does nearly as well
    assert ours[0] < 2.0
    assert ours[1] < 0.02


def test_noisy_copies_of_points_are_aligned_point_to_point() -> None:
    points, random = potato(600, 5), np.random.default_rng(5)
    surfaces = pair(*(points + 0.008 * random.normal(size=points.shape) for _ in range(2)))
    found = few(surfaces, NUDGE)
    again = refine(surfaces, found, surfaces.spacing, "point", iterations=100)
    np.testing.assert_allclose(again, found, atol=1e-5)  # the points themselves have the last word
    assert off(found, np.eye(4))[0] < off(symmetric(surfaces, NUDGE), np.eye(4))[0]


def test_clouds_that_move_move_the_answer() -> None:
    source, target = scans(3)
    motion, moved = rigid([1.0, -0.5, 0.3], [0.2, 0.1, -0.3]), move(NUDGE, target)
    plain = symmetric(pair(source, moved), np.eye(4))
    turned = symmetric(pair(move(motion, source), moved), np.linalg.inv(motion))
    np.testing.assert_allclose(turned @ motion, plain, atol=1e-4)


def test_clouds_exchanged_invert_the_answer() -> None:
    surfaces = pair(*scans(4))
    forth = symmetric(surfaces, NUDGE)
    back = symmetric(surfaces.swapped, np.linalg.inv(NUDGE))
    angle, shift = off(back @ forth, np.eye(4))
    assert angle < 0.1
    assert shift < 0.001


def test_what_is_aligned_stays() -> None:
    cloud = potato(300, 1)
    np.testing.assert_allclose(few(pair(cloud, cloud), np.eye(4)), np.eye(4), atol=1e-12)


def test_clouds_far_apart_keep_the_start() -> None:
    far = rigid([0.1, 0.0, 0.0], [9.0, 0.0, 0.0])
    np.testing.assert_allclose(few(pair(*scans(2)), far), far, atol=1e-12)


def flat(count: int, random: np.random.Generator) -> np.ndarray:
    return random.uniform(-1, 1, size=(count, 3)) * [1, 1, 0]


def test_a_plane_does_not_slide_away() -> None:
    random = np.random.default_rng(0)
    surfaces = pair(flat(300, random), flat(300, random), 0.06)
    found = symmetric(surfaces, rigid([0.02, 0.03, 0.0], [0.0, 0.0, 0.03]))
    assert abs(found[2, 3]) < 1e-3  # on the plane
    assert np.linalg.norm(found[:2, 3]) < 0.06  # within a spacing of where it was
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-12)


def test_what_slides_freely_rests_where_points_lie_evenly() -> None:
    random = np.random.default_rng(1)
    surfaces = pair(flat(500, random), flat(500, random), 0.06)
    start = rigid([0.0, 0.0, 0.0], [0.06, -0.04, 0.0])  # a table's top, slid
    assert np.linalg.norm(symmetric(surfaces, start)[:2, 3]) < 0.5 * np.linalg.norm(start[:2, 3])
