"""Shifts that points of rare normals vote for."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.search.repeats import PLACES, repeats
from motions import move
from motions import rigid as motion

POSE = motion([0.4, -1.1, 0.7], [0.2, -0.3, 0.1])
BAY = 0.4
"""From one pillar to the next."""


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


@pytest.fixture(scope="module")
def bays() -> Surfaces:
    """Five bays, and five that are two further along."""
    source, target = pillars(1, 0, 5), move(POSE, pillars(2, 2, 5))
    return Surfaces(Surface.of(source), Surface.of(target), spacing_of(source))


def test_the_right_shift_and_the_repeats_are_among_the_most_voted(bays: Surfaces) -> None:
    elsewhere = POSE @ motion([0, 0, 0], [0.17, 0.05, -0.03])
    found = repeats(bays, elsewhere)
    assert 3 <= len(found) <= PLACES
    along = np.array([np.linalg.inv(POSE) @ pose for pose in found])[:, :3, 3]
    for bay in (1, 2, 3):  # the most pillars lie on each other two further, and all look alike
        assert np.linalg.norm(along - [bay * BAY, 0, 0], axis=1).min() < 3 * bays.spacing


def test_the_rotation_stays(bays: Surfaces) -> None:
    for pose in repeats(bays, POSE):
        np.testing.assert_array_equal(pose[:3, :3], POSE[:3, :3])


def test_no_two_shifts_are_near_each_other(bays: Surfaces) -> None:
    shifts = repeats(bays, POSE)[:, :3, 3]
    apart = np.linalg.norm(shifts[:, None] - shifts[None], axis=-1)[~np.eye(len(shifts), dtype=bool)]
    assert apart.min() > 2 * bays.spacing


def test_where_no_normals_agree_nothing_is_voted_for() -> None:
    floor = np.c_[np.random.default_rng(0).uniform(-1, 1, (400, 2)), np.zeros(400)]
    surfaces = Surfaces(Surface.of(floor), Surface.of(floor), 0.05)
    assert repeats(surfaces, motion([np.pi / 2, 0, 0], [0, 0, 0])).shape == (0, 4, 4)
    assert len(repeats(surfaces, np.eye(4))) > 0
