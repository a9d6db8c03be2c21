"""Poses slid along the surface that two clouds share."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from idam.align import Refinable, Surfaces
from idam.clouds.pyramid import Level
from idam.search.matching import Matching
from idam.search.ranking import Answer, scored
from idam.search.sparse.copies import SLIPPABLE
from idam.search.sparse.slippage import FARTHEST, slid, slips
from matchings import anything, matching_by, scores_for, vase
from motions import rigid


def table(seed: int) -> np.ndarray:
    """Points on a table's top, which slides along itself and turns in its plane."""
    return np.random.default_rng(seed).uniform([-0.6, -0.4, 0.0], [0.6, 0.4, 0.0], (400, 3))


def corner() -> np.ndarray:
    """Points on three walls that meet, which hold each other."""
    rng = np.random.default_rng(0)
    return np.concatenate([np.insert(rng.uniform(0, 1, (200, 2)), axis, 0.0, axis=1) for axis in range(3)])


def told_by_features(source: np.ndarray, target: np.ndarray) -> Matching:
    """Two clouds whose features say that they lie as they are."""
    clouds = Level(source, target, 0.05)
    return matching_by(clouds, scores_for(clouds, np.eye(4)))


# --- slips ---------------------------------------------------------------------------------------------------------


def test_a_surface_of_revolution_slips_round_its_axis() -> None:
    source, target = Refinable.build(vase(700, 1)), Refinable.build(vase(700, 2))
    found = slips(Surfaces(source, target, 0.05), np.eye(4), SLIPPABLE)
    assert len(found) > 30
    np.testing.assert_allclose(found[:, 2, 2], 1.0, atol=0.02)  # about z
    np.testing.assert_allclose(
        found[:, :3, :3] @ found[:, :3, :3].swapaxes(1, 2), np.eye(3)[None].repeat(len(found), 0), atol=1e-9
    )
    angle = np.degrees(np.arctan2(found[:, 1, 0], found[:, 0, 0]))
    assert angle.max() > 165  # all the way round
    assert angle.min() < -165


def test_a_plane_slips_along_itself_and_no_further_than_said() -> None:
    rng = np.random.default_rng(0)
    source, target = (Refinable.build(rng.uniform(-1, 1, (600, 3)) * [1, 1, 0]) for _ in range(2))
    found = slips(Surfaces(source, target, 0.06), np.eye(4), SLIPPABLE)
    assert np.abs(found[:, 2, 3]).max() < 0.02  # in the plane
    pure = found[np.abs(found[:, 0, 0] - 1) < 1e-6]
    assert len(pure) > 4
    assert np.linalg.norm(pure[:, :3, 3], axis=1).max() <= FARTHEST + 1e-6


def test_what_holds_does_not_slip() -> None:
    cloud = Refinable.build(corner())
    assert len(slips(Surfaces(cloud, cloud, 0.05), np.eye(4), SLIPPABLE)) == 0


def test_clouds_apart_do_not_slip() -> None:
    cloud = Refinable.build(vase(300, 1))
    assert slips(Surfaces(cloud, cloud, 0.05), rigid([0.0, 0.0, 0.0], [5.0, 0.0, 0.0]), SLIPPABLE).shape == (0, 4, 4)


# --- slid ----------------------------------------------------------------------------------------------------------


def test_an_answer_that_has_slipped_is_slid_back() -> None:
    matching = told_by_features(table(0), table(1))
    slipped = scored(rigid([0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), matching, sparse=True)
    found = slid([slipped], matching, anything, "symmetric")
    assert found[0].score > 2 * slipped.score
    assert np.linalg.norm(found[0].transformation[:3, 3]) < 0.05
    assert found[1:] == [slipped]


def test_a_right_answer_stays() -> None:
    matching = told_by_features(table(0), table(1))
    right = scored(np.eye(4), matching, sparse=True)
    other = Answer(rigid([0.0, 3.0, 0.0], [0.0, 0.0, 0.0]))
    found = slid([right, other], matching, anything, "symmetric")
    assert np.linalg.norm(found[0].transformation[:3, 3]) < 0.05
    assert found[0].score >= right.score
    assert found[-1] is other


def test_what_holds_is_not_slid() -> None:
    points = corner()
    answers = [scored(np.eye(4), told_by_features(points, points), sparse=True)]
    assert slid(answers, told_by_features(points, points), anything, "symmetric") == answers


def test_nothing_is_slid_too_far() -> None:
    def none(_: Iterable[np.ndarray]) -> list[Answer]:
        return []

    matching = told_by_features(table(0), table(1))
    answers = [scored(rigid([0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), matching, sparse=True)]
    assert slid(answers, matching, none, "symmetric") == answers
