"""The transforms that sets of matches agree on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from idam.search.consensus import _second_order_compatibility, agreeing_transforms
from idam.search.matching import FeatureMatches
from matchings import TOLERANCE, as_matches, example, swapped
from motions import move, rigid

TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
MOTION = rigid([0.3, 2.0, -1.0], [0.5, -0.4, 0.2])
SEEDS = 200


@pytest.mark.parametrize("seed", range(5))
def test_truth_comes_first_though_nine_of_ten_matches_are_wrong(seed: int) -> None:
    first = agreeing_transforms(example((TRUTH, 30), wrong=270, seed=seed), SEEDS)[0]
    np.testing.assert_allclose(first, TRUTH, atol=1e-3)
    np.testing.assert_allclose(first[:3, :3] @ first[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(first[3], [0, 0, 0, 1])


def test_noise_within_the_tolerance_is_borne() -> None:
    matches = example((TRUTH, 60), wrong=240)
    noise = np.random.default_rng(1).normal(0, 0.2 * TOLERANCE, (len(matches.source), 3))
    first = agreeing_transforms(as_matches(matches.source.numpy(), matches.target.numpy() + noise), SEEDS)[0]
    np.testing.assert_allclose(first, TRUTH, atol=0.02)


def test_the_larger_of_two_sets_comes_first_and_the_smaller_later() -> None:
    found = agreeing_transforms(example((OTHER, 25), (TRUTH, 40), wrong=150), SEEDS)
    off = [[np.abs(transformation - expected).max() for transformation in found] for expected in (TRUTH, OTHER)]
    assert off[0][0] < 1e-3
    assert min(off[1]) < 1e-3
    assert np.flatnonzero(np.array(off[0]) < 1e-3).max() < np.flatnonzero(np.array(off[1]) < 1e-3).min()


def test_moving_both_ends_moves_the_transform() -> None:
    matches = example((TRUTH, 30), wrong=270)
    moved = as_matches(move(MOTION, matches.source.numpy()), move(OTHER, matches.target.numpy()))
    expected = OTHER @ TRUTH @ np.linalg.inv(MOTION)
    np.testing.assert_allclose(agreeing_transforms(moved, SEEDS)[0], expected, atol=1e-3)


def test_order_of_the_matches_does_not_matter() -> None:
    matches = example((TRUTH, 30), wrong=270)
    rows = torch.randperm(len(matches.source))
    shuffled = FeatureMatches(matches.source[rows], matches.target[rows], TOLERANCE)
    np.testing.assert_allclose(
        agreeing_transforms(shuffled, SEEDS)[0], agreeing_transforms(matches, SEEDS)[0], atol=1e-5
    )


def test_swapping_the_ends_inverts_the_transforms() -> None:
    matches = example((TRUTH, 40), (OTHER, 25), wrong=100)
    forth, back = agreeing_transforms(matches, SEEDS), agreeing_transforms(swapped(matches), SEEDS)
    assert len(forth) == len(back)
    np.testing.assert_allclose(np.linalg.inv(back[0]), forth[0], atol=1e-4)


@pytest.mark.parametrize("seeds", [1, 7])
def test_as_many_transforms_as_seeds_those_of_the_most_compatible_matches(seeds: int) -> None:
    found = agreeing_transforms(example((TRUTH, 30), wrong=270), seeds)
    assert len(found) == seeds
    for transformation in found:
        np.testing.assert_allclose(transformation, TRUTH, atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_matches_agree_on_nothing(count: int) -> None:
    assert agreeing_transforms(example((TRUTH, count), wrong=0), SEEDS) == []


@pytest.mark.parametrize("count", [3, 4, 25])
def test_a_few_right_matches_are_enough(count: int) -> None:
    np.testing.assert_allclose(agreeing_transforms(example((TRUTH, count), wrong=0), SEEDS)[0], TRUTH, atol=1e-3)


def test_matches_that_all_contradict_each_other_or_coincide_give_rigid_transforms() -> None:
    contradicting = as_matches(np.eye(3), 9 * np.eye(3))
    coinciding = as_matches(np.ones((5, 3)), np.ones((5, 3)))
    for matches in (contradicting, coinciding):
        for transformation in agreeing_transforms(matches, SEEDS):
            rotation = transformation[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) > 0
            assert np.isfinite(transformation).all()


def second_order_by_definition(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    count = len(source)
    compatible = np.abs(cdist(source, source) - cdist(target, target)) < TOLERANCE
    np.fill_diagonal(compatible, False)
    expected = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            if compatible[i, j]:
                expected[i, j] = sum(compatible[i, k] and compatible[j, k] for k in range(count))
    return expected


@pytest.mark.parametrize("wrong", [0, 8, 30])
def test_second_order_compatibility_is_that_of_the_definition(wrong: int) -> None:
    matches = example((TRUTH, 12), wrong=wrong)
    found = _second_order_compatibility(matches.source, matches.target, TOLERANCE)
    expected = second_order_by_definition(matches.source.double().numpy(), matches.target.double().numpy())
    np.testing.assert_array_equal(found, expected)
    assert expected.any()
