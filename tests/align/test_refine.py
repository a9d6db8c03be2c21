"""Fine alignment on dense clouds."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from idam.align import METHODS, Refinable, Surfaces, align, reaches, refine
from idam.clouds.frame import Frame, common_frame, downsample
from idam.errors import InputError
from idam.io import read_point_cloud

DISTANCE = 0.1
NUDGE = np.array([0.03, -0.04, 0.05])
"""Radians; and working units, in another order."""

Pair = tuple[Refinable, Refinable, np.ndarray]


@pytest.fixture(scope="module")
def pair() -> Pair:
    """The shipped scans, half of each in the other, at about 3000 points each, and the true working transform."""
    folder = resources.files("idam") / "data" / "demo"
    with resources.as_file(folder) as path:
        source, target = (read_point_cloud(path / name).points for name in ("source.ply", "target.ply"))
        truth = np.loadtxt(path / "truth.txt")
    frame: Frame = common_frame(source, target)
    source, target = downsample(frame.source(source), 0.033), downsample(frame.target(target), 0.033)
    return Refinable.build(source), Refinable.build(target), frame.enter(truth)


def nudged(transformation: np.ndarray, size: float = 1.0) -> np.ndarray:
    nudge = np.eye(4)
    nudge[:3, :3] = Rotation.from_rotvec(size * NUDGE).as_matrix()
    nudge[:3, 3] = size * NUDGE[::-1]
    return nudge @ transformation


def errors(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Degrees and working units between two transforms of a cloud centred at the origin."""
    angle = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()
    return float(np.degrees(angle)), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def test_refinable_keeps_points_and_has_unit_normals(pair: Pair) -> None:
    points = np.random.default_rng(0).uniform(size=(200, 3)) * [1, 1, 0]
    flat = Refinable.build(points)
    np.testing.assert_array_equal(flat.points, points)
    np.testing.assert_allclose(np.abs(flat.normals), np.tile([0.0, 0.0, 1.0], (200, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(pair[0].normals, axis=1), 1.0, atol=1e-6)


def test_refinable_makes_its_search_tree_once(pair: Pair) -> None:
    distance, index = pair[0].search.query(pair[0].points)
    np.testing.assert_array_equal(index, np.arange(len(pair[0].points)))
    assert not distance.any()
    assert pair[0].search is pair[0].search


@pytest.mark.parametrize("method", METHODS)
def test_recovers_a_small_perturbation(pair: Pair, method: str) -> None:
    source, target, truth = pair
    start = nudged(truth)
    assert errors(start, truth) > (4.0, 0.07)
    found, information = refine(source, target, start, DISTANCE, method)
    angle, shift = errors(found, truth)
    # what lies outside the overlap, within the distance all the same, pulls on the simpler methods
    assert angle < (0.3 if method == "gicp" else 1.5)
    assert shift < (0.003 if method == "gicp" else 0.02)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])
    np.testing.assert_allclose(information, information.T, rtol=1e-6)
    assert np.linalg.eigvalsh(information).min() > 0


@pytest.mark.parametrize("method", METHODS)
def test_is_deterministic(pair: Pair, method: str) -> None:
    source, target, truth = pair
    once, again = (refine(source, target, nudged(truth), DISTANCE, method) for _ in range(2))
    np.testing.assert_array_equal(once[0], again[0])
    np.testing.assert_array_equal(once[1], again[1])


def test_the_methods_differ(pair: Pair) -> None:
    source, target, truth = pair
    found = [refine(source, target, nudged(truth), DISTANCE, method)[0] for method in METHODS]
    assert all((a != b).any() for a, b in zip(found, found[1:] + found[:1], strict=True))


def test_goes_no_further_than_its_iterations(pair: Pair) -> None:
    source, target, truth = pair
    far = [errors(refine(source, target, nudged(truth, 2), DISTANCE, "point", n)[0], truth)[0] for n in (1, 3, 30)]
    assert far[0] > far[1] > far[2]


@pytest.mark.parametrize("method", METHODS)
def test_without_overlap_the_start_stays(pair: Pair, method: str) -> None:
    source, target, truth = pair
    start = truth.copy()
    start[:3, 3] += 50.0
    found, information = refine(source, target, start, DISTANCE, method)
    np.testing.assert_array_equal(found, start)
    np.testing.assert_array_equal(information, np.zeros((6, 6)))


def test_a_touch_of_a_few_points_is_no_overlap(pair: Pair) -> None:
    target = pair[1].points
    few = target[::700] + np.array([0.01, 0.02, -0.01])
    assert 3 < len(few) < 10
    source = Refinable.build(np.vstack([few, target + 50.0]))
    found, information = refine(source, pair[1], np.eye(4), DISTANCE)
    np.testing.assert_array_equal(found, np.eye(4))
    assert not information.any()


def test_unknown_method(pair: Pair) -> None:
    source, target, truth = pair
    with pytest.raises(InputError, match=r"^unknown refinement 'magic': choose gicp, plane, point, symmetric or none$"):
        refine(source, target, truth, DISTANCE, "magic")


@pytest.mark.parametrize("method", METHODS)
def test_align_takes_lengths_in_spacings(pair: Pair, method: str) -> None:
    source, target, truth = pair
    start = nudged(truth, 2)
    spacing = DISTANCE / 2
    found, information = align(Surfaces(source, target, spacing), start, reaches(method)[1], method)
    assert errors(found, truth)[0] < 0.5 * errors(start, truth)[0]
    assert np.linalg.eigvalsh(information).min() > 0


def test_align_by_no_method_ends_where_it_starts(pair: Pair) -> None:
    source, target, truth = pair
    start = nudged(truth, 2)
    found, information = align(Surfaces(source, target, DISTANCE), start, 2.0, "none")
    np.testing.assert_array_equal(found, start)
    assert not information.any()
