"""Fine alignment on dense clouds."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from idam.align import METHODS, align, reaches, refine
from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
from idam.clouds.surfaces import Surface, Surfaces
from idam.errors import InputError
from idam.io import read_point_cloud
from motions import degrees, rigid

DISTANCE = 0.1
NUDGE = np.array([0.03, -0.04, 0.05])
"""Radians; and working units, in another order."""
DEMO = resources.files("idam.demo")
TRUTH = np.loadtxt(str(resources.files("idam.lab.data") / "demo" / "truth.txt"))

Pair = tuple[Surfaces, np.ndarray]


@pytest.fixture(scope="module")
def pair() -> Pair:
    """The shipped scans, half of each in the other, at about 3000 points each, and the true working transform."""
    with resources.as_file(DEMO / "source.ply") as source, resources.as_file(DEMO / "target.ply") as target:
        clouds = Pyramid(*(Prepared.of(read_point_cloud(path).points, "scan") for path in (source, target)))
    level = clouds.with_points(3000)
    return replace(level.surfaces, spacing=DISTANCE / 2), clouds.enter(TRUTH)


def nudged(transformation: np.ndarray, size: float = 1.0) -> np.ndarray:
    return rigid(size * NUDGE, size * NUDGE[::-1]) @ transformation


def errors(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Degrees and working units between two transforms of a cloud centred at the origin."""
    return degrees(a, b), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


@pytest.mark.parametrize("method", METHODS)
def test_recovers_a_small_perturbation(pair: Pair, method: str) -> None:
    surfaces, truth = pair
    start = nudged(truth)
    assert errors(start, truth) > (4.0, 0.07)
    found = refine(surfaces, start, DISTANCE, method)
    angle, shift = errors(found, truth)
    # what lies outside the overlap, within the distance all the same, pulls on the simpler methods
    assert angle < (0.3 if method == "gicp" else 1.5)
    assert shift < (0.005 if method == "gicp" else 0.02)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


@pytest.mark.parametrize("method", METHODS)
def test_is_deterministic_and_leaves_the_start_as_it_was(pair: Pair, method: str) -> None:
    surfaces, truth = pair
    start = nudged(truth)
    once, again = (refine(surfaces, start, DISTANCE, method) for _ in range(2))
    np.testing.assert_array_equal(once, again)
    np.testing.assert_array_equal(start, nudged(truth))


def test_the_methods_differ(pair: Pair) -> None:
    surfaces, truth = pair
    found = [refine(surfaces, nudged(truth), DISTANCE, method) for method in METHODS]
    assert all((a != b).any() for a, b in zip(found, found[1:] + found[:1], strict=True))


def test_goes_no_further_than_its_iterations(pair: Pair) -> None:
    surfaces, truth = pair
    far = [errors(refine(surfaces, nudged(truth, 2), DISTANCE, "point", n), truth)[0] for n in (1, 3, 30)]
    assert far[0] > far[1] > far[2]


@pytest.mark.parametrize("method", METHODS)
def test_without_overlap_the_start_stays(pair: Pair, method: str) -> None:
    surfaces, truth = pair
    start = truth.copy()
    start[:3, 3] += 50.0
    np.testing.assert_allclose(refine(surfaces, start, DISTANCE, method), start, atol=1e-12)


def test_a_touch_of_a_few_points_is_no_overlap(pair: Pair) -> None:
    target = pair[0].target
    few = target.points[::700] + np.array([0.01, 0.02, -0.01])
    assert 3 < len(few) < 10
    source = Surface.of(np.vstack([few, target.points + 50.0]))
    np.testing.assert_array_equal(refine(Surfaces(source, target, 0.05), np.eye(4), DISTANCE), np.eye(4))


def test_unknown_method(pair: Pair) -> None:
    surfaces, truth = pair
    with pytest.raises(InputError, match=r"^unknown refinement 'magic': choose gicp, plane, point, symmetric or none$"):
        refine(surfaces, truth, DISTANCE, "magic")


@pytest.mark.parametrize("method", METHODS)
def test_align_takes_lengths_in_spacings(pair: Pair, method: str) -> None:
    surfaces, truth = pair
    start = nudged(truth, 2)
    found = align(surfaces, start, reaches(method)[1], method)
    assert errors(found, truth)[0] < 0.5 * errors(start, truth)[0]
    if method != "symmetric":
        expected = refine(surfaces, start, reaches(method)[1] * surfaces.spacing, method)
        np.testing.assert_array_equal(found, expected)


def test_align_by_no_method_ends_where_it_starts(pair: Pair) -> None:
    surfaces, truth = pair
    start = nudged(truth, 2)
    np.testing.assert_array_equal(align(surfaces, start, 2.0, "none"), start)
