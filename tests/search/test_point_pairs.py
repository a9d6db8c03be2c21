"""The transforms that every two matches of oriented points agree on."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest

from idam import rigid as maths
from idam.clouds.surfaces import Surface, Surfaces
from idam.search.consensus import agreeing_transforms
from idam.search.matching import FeatureMatches
from idam.search.point_pairs import ANGLE, APART, KEPT, _alike, point_pair_transforms
from matchings import swapped
from motions import move, rigid
from solids import potato

TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
TOLERANCE = 0.06


def example(right: int, wrong: int, seed: int = 0) -> tuple[FeatureMatches, Surfaces]:
    """A cloud and itself moved, some of whose points are matched rightly and the others at random."""
    random = np.random.default_rng(seed)
    points = potato(1500, seed)
    moved = move(TRUTH, points)
    i, j = (random.permutation(len(points))[: right + wrong] for _ in range(2))
    j[:right] = i[:right]
    order = random.permutation(right + wrong)
    surfaces = Surfaces(Surface.of(points), Surface.of(moved), 0.04)
    return FeatureMatches(points[i[order]], moved[j[order]], TOLERANCE), surfaces


def errors(transforms: np.ndarray) -> np.ndarray:
    """Degrees from the truth, (S,)."""
    return np.degrees(maths.angle(transforms[:, :3, :3] @ TRUTH[:3, :3].T))


@pytest.mark.parametrize("seed", range(5))
def test_a_few_right_matches_of_hundreds_come_first(seed: int) -> None:
    matches, surfaces = example(12, 288, seed)
    assert errors(point_pair_transforms(matches, surfaces)[:3]).min() < 5


def test_a_small_set_shows_next_to_one_with_more_matches_than_others_have_seeds() -> None:
    mine, other = potato(800, 1), potato(800, 2) + np.array([0, 0, 2.5])
    theirs, elsewhere = move(TRUTH, mine), move(OTHER, other)
    both = (Surface.of(np.concatenate(clouds)) for clouds in ((mine, other), (theirs, elsewhere)))
    ends = (np.concatenate([one[:300], few[:10]]) for one, few in ((other, mine), (elsewhere, theirs)))
    matches, surfaces = FeatureMatches(*ends, TOLERANCE), Surfaces(*both, 0.04)
    assert errors(point_pair_transforms(matches, surfaces)).min() < 3
    assert errors(agreeing_transforms(matches, 200)).min() > 10


def test_transforms_are_rigid() -> None:
    found = point_pair_transforms(*example(10, 190))
    assert 10 < len(found) <= KEPT
    rotation = found[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )
    assert (np.linalg.det(rotation) > 0).all()


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_matches_agree_on_nothing(count: int) -> None:
    assert point_pair_transforms(*example(count, 0)).shape == (0, 4, 4)


def test_matches_that_agree_on_nothing_give_nothing() -> None:
    matches, surfaces = example(0, 2)
    assert abs(np.subtract(*(np.ptp(points, axis=0).max() for points in (matches.source, matches.target)))) > TOLERANCE
    assert point_pair_transforms(matches, surfaces).shape == (0, 4, 4)


def test_swapping_the_ends_inverts_the_first_transform() -> None:
    matches, surfaces = example(30, 170)
    forth, back = (
        point_pair_transforms(matches, surfaces)[0],
        point_pair_transforms(swapped(matches), surfaces.swapped)[0],
    )
    np.testing.assert_allclose(forth @ back, np.eye(4), atol=1e-9)


def likeness(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """What a motion leaves as it is of two oriented points, by definition."""
    line = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    return np.array(
        [normals[0] @ line, normals[1] @ line, normals[0] @ normals[1], np.cross(normals[0], line) @ normals[1]]
    )


def agreeing_pairs(matches: FeatureMatches, surfaces: Surfaces) -> int:
    """How many pairs of matches agree, with either sign of the source's normals, one after the other."""
    number, tolerance = 0, matches.tolerance
    ends = (matches.source, surfaces.source), (matches.target, surfaces.target)
    normals = [surface.normals[surface.nearest(points)[1]] for points, surface in ends]
    for two in combinations(range(len(matches.source)), 2):
        rows = list(two)
        long, other = (float(np.linalg.norm(points[rows[1]] - points[rows[0]])) for points, _ in ends)
        if abs(long - other) >= tolerance or min(long, other) <= APART * tolerance:
            continue
        for signs in product((1, -1), repeat=2):
            mine = likeness(matches.source[rows], normals[0][rows] * np.array(signs)[:, None])
            gap = np.abs(mine - likeness(matches.target[rows], normals[1][rows]))
            short = ANGLE + 0.5 * tolerance / long
            number += bool((gap < [short, short, ANGLE, short]).all())
    return number


def test_pairs_are_those_of_a_loop_over_all() -> None:
    matches, surfaces = example(15, 25)
    source, target = _alike(matches, surfaces)
    assert len(source.length) == len(target.length) == agreeing_pairs(matches, surfaces) > 50
