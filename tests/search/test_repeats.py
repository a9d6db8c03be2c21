"""Where else two scans fit, by a correlation of their maps."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.clouds.viewpoint import FreeSpace
from idam.search import repeats as module
from idam.search.repeats import APART, CELL, PLACES, repeats
from motions import move
from motions import rigid as motion

POSE = motion([0.4, -1.1, 0.7], [0.2, -0.3, 0.1])
BAY = 0.4
"""From one pillar to the next."""
HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""No turn, and half turns about the axes: signs of the coordinates, (4, 3)."""


def pillars(seed: int, first: int, number: int) -> np.ndarray:
    """A floor and a wall along x with square pillars in front of it, evenly spaced; points all over them."""
    random = np.random.default_rng(seed)
    start, length = first * BAY, number * BAY
    x, across = start + length * random.uniform(size=1200), random.uniform(0, 0.5, 1200)
    floor, wall = np.stack([x, across, 0 * x], 1)[:600], np.stack([x, 0 * x, across], 1)[600:]
    parts = [floor, wall]
    for bay in range(first, first + number):
        sides = random.uniform(-0.04, 0.04, (150, 3))
        rows = np.arange(len(sides))
        sides[rows, random.integers(2, size=len(sides))] = random.choice([-0.04, 0.04], len(sides))
        sides[:, 2] = random.uniform(0, 0.4, len(sides))
        parts.append(sides + np.array([(bay + 0.5) * BAY, 0.25, 0.0]))
    return np.concatenate(parts)


def seen(surfaces: Surfaces, eyes: tuple[np.ndarray | None, np.ndarray | None] = (None, None)) -> FreeSpace:
    return FreeSpace.of(surfaces.source, surfaces.target, eyes, 0.0)


@pytest.fixture(scope="module")
def bays() -> Surfaces:
    """Five bays, and five that are two further along."""
    source, target = pillars(1, 0, 5), move(POSE, pillars(2, 2, 5))
    return Surfaces(Surface.of(source), Surface.of(target), spacing_of(source))


@pytest.fixture(scope="module")
def found(bays: Surfaces) -> np.ndarray:
    """Relative to the pose."""
    poses = repeats(bays, seen(bays), POSE)
    return np.linalg.inv(POSE) @ poses


def test_the_next_bays_fit_as_well(found: np.ndarray) -> None:
    assert 3 <= len(found) <= PLACES
    upright = found[np.abs(found[:, :3, :3] - np.eye(3)).max((1, 2)) < 1e-9, :3, 3]
    for bay in (1, 2, 3):  # the most pillars lie on each other two further, and all look alike
        assert np.linalg.norm(upright - [bay * BAY, 0, 0], axis=1).min() < 2 * CELL


def test_the_scans_are_turned_by_half_or_not_at_all(found: np.ndarray) -> None:
    traces = found[:, :3, :3].trace(axis1=1, axis2=2)
    assert np.isclose(traces[:, None], [3.0, -1.0]).any(1).all()
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1.0)


def test_no_two_are_near_each_other_or_the_pose(found: np.ndarray) -> None:
    both = np.concatenate([np.eye(4)[None], found])
    for one, other in itertools.combinations(both, 2):
        turned = np.trace(one[:3, :3].T @ other[:3, :3]) < 2.9
        assert turned or np.abs(one[:3, 3] - other[:3, 3]).max() > APART * CELL / 3**0.5


def test_what_a_scan_saw_through_is_no_place_to_be() -> None:
    """A wall behind a wall: the scan of the farther one sees through where the nearer one would be."""
    random = np.random.default_rng(0)
    wall = np.c_[random.uniform(-0.5, 0.5, (1500, 2)), np.zeros(1500)]
    near, far = (wall + np.array([0, 0, z]) for z in (0.3, 0.8))
    both = Surfaces(Surface.of(np.concatenate([near, far])), Surface.of(far), 0.03)
    onto = np.eye(4)

    def steps(eye: np.ndarray | None) -> np.ndarray:
        """How far along z the two walls are shifted."""
        return repeats(both, seen(both, (None, eye)), onto)[:, 2, 3]

    assert (np.abs(steps(None) - 0.5) < 2 * CELL).any()  # the near one on the far one, the far one behind it
    # at the pose the near wall stands in free space, and behind the far one it is not seen
    shifts = steps(np.array([0.0, 0.0, -1.0]))
    assert len(shifts) > 0
    assert np.abs(shifts[0] - 0.5) < 2 * CELL


def test_the_score_is_what_each_lays_on_the_other_and_in_its_free_space() -> None:
    random = np.random.default_rng(0)

    def mapped(size: tuple[int, int, int], low: list[int]) -> module._Mapped:
        share = random.uniform(size=size) * (random.uniform(size=size) < 0.3)
        fit = random.choice([-5.0, 0.0, 1.0], size)
        return module._Mapped(np.array(low), (share / share.sum()).astype(np.float32), fit.astype(np.float32))

    source, target = mapped((3, 4, 2), [-2, 0, 1]), mapped((4, 3, 3), [1, -3, 0])
    score = module._correlations(source, target)

    def cells(held: module._Mapped) -> dict[tuple[int, ...], tuple[float, float]]:
        """Share and fit by the middle of each cell, in halves of a cell."""
        return {
            tuple(2 * (np.array(at) + held.low) + 1): (float(share), float(held.fit[at]))
            for at, share in np.ndenumerate(held.share)
        }

    mine, theirs = cells(source), cells(target)
    for place in itertools.product(range(4), *(range(n) for n in score.shape[1:])):
        pose = module._pose(place, source, target, np.eye(3), np.eye(3), 1.0, score.shape[1:])
        np.testing.assert_array_equal(pose[:3, :3], np.diag(HALF_TURNS[place[0]]))
        direct = 0.0
        for middle, (share, fit) in mine.items():
            other = theirs.get(tuple((HALF_TURNS[place[0]] * middle + 2 * pose[:3, 3]).astype(int)), (0.0, 0.0))
            direct += (share * other[1] + fit * other[0]) / 2
        assert score[place] == pytest.approx(direct, abs=1e-5)


@pytest.mark.parametrize("number", [1, 7, 31, 97, 128, 241, 1001])
def test_a_quick_size_is_the_least_of_small_factors(number: int) -> None:
    def small(n: int) -> bool:
        for factor in (2, 3, 5):
            while n % factor == 0:
                n //= factor
        return n == 1

    assert module._quick(number) == next(n for n in itertools.count(number) if small(n))
