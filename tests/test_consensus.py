"""Feature matches, and the transforms that sets of them agree on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from idam import consensus
from idam.consensus import (
    FEW,
    RANK,
    REACH,
    FeatureMatches,
    _second_order_compatibility,
    agreeing_transforms,
    match_features,
    mutual_matches,
)
from motions import move, rigid

TOLERANCE = 0.02


TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
MOTION = rigid([0.3, 2.0, -1.0], [0.5, -0.4, 0.2])


def as_matches(source: np.ndarray, target: np.ndarray) -> FeatureMatches:
    return FeatureMatches(
        torch.as_tensor(source, dtype=torch.float32), torch.as_tensor(target, dtype=torch.float32), TOLERANCE
    )


def example(*right: tuple[np.ndarray, int], wrong: int, seed: int = 0) -> FeatureMatches:
    """Without noise: some that agree with each of the transforms, and wrong ones among them, in any order."""
    random = np.random.default_rng(seed)
    source = random.uniform(-0.6, 0.6, (sum(n for _, n in right) + wrong, 3))
    target = random.uniform(-0.6, 0.6, source.shape)
    first = 0
    for transformation, count in right:
        target[first : first + count] = move(transformation, source[first : first + count])
        first += count
    rows = random.permutation(len(source))
    return as_matches(source[rows], target[rows])


def swapped(matches: FeatureMatches) -> FeatureMatches:
    return FeatureMatches(matches.target, matches.source, matches.tolerance)


# --- transforms that matches agree on ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_truth_comes_first_though_nine_of_ten_matches_are_wrong(seed: int) -> None:
    first = agreeing_transforms(example((TRUTH, 30), wrong=270, seed=seed))[0]
    np.testing.assert_allclose(first, TRUTH, atol=1e-3)
    np.testing.assert_allclose(first[:3, :3] @ first[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(first[3], [0, 0, 0, 1])


def test_noise_within_the_tolerance_is_borne() -> None:
    matches = example((TRUTH, 60), wrong=240)
    noise = np.random.default_rng(1).normal(0, 0.2 * TOLERANCE, (len(matches.source), 3))
    first = agreeing_transforms(as_matches(matches.source.numpy(), matches.target.numpy() + noise))[0]
    np.testing.assert_allclose(first, TRUTH, atol=0.02)


def test_the_larger_of_two_sets_comes_first_and_the_smaller_later() -> None:
    found = agreeing_transforms(example((OTHER, 25), (TRUTH, 40), wrong=150))
    off = [[np.abs(transformation - expected).max() for transformation in found] for expected in (TRUTH, OTHER)]
    assert off[0][0] < 1e-3
    assert min(off[1]) < 1e-3
    assert np.flatnonzero(np.array(off[0]) < 1e-3).max() < np.flatnonzero(np.array(off[1]) < 1e-3).min()


def test_moving_both_ends_moves_the_transform() -> None:
    matches = example((TRUTH, 30), wrong=270)
    moved = as_matches(move(MOTION, matches.source.numpy()), move(OTHER, matches.target.numpy()))
    expected = OTHER @ TRUTH @ np.linalg.inv(MOTION)
    np.testing.assert_allclose(agreeing_transforms(moved)[0], expected, atol=1e-3)


def test_order_of_the_matches_does_not_matter() -> None:
    matches = example((TRUTH, 30), wrong=270)
    rows = torch.randperm(len(matches.source))
    shuffled = FeatureMatches(matches.source[rows], matches.target[rows], TOLERANCE)
    np.testing.assert_allclose(agreeing_transforms(shuffled)[0], agreeing_transforms(matches)[0], atol=1e-5)


def test_swapping_the_ends_inverts_the_transforms() -> None:
    matches = example((TRUTH, 40), (OTHER, 25), wrong=100)
    forth, back = agreeing_transforms(matches), agreeing_transforms(swapped(matches))
    assert len(forth) == len(back)
    np.testing.assert_allclose(np.linalg.inv(back[0]), forth[0], atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_matches_agree_on_nothing(count: int) -> None:
    assert agreeing_transforms(example((TRUTH, count), wrong=0)) == []


@pytest.mark.parametrize("count", [3, 4, 25])
def test_a_few_right_matches_are_enough(count: int) -> None:
    np.testing.assert_allclose(agreeing_transforms(example((TRUTH, count), wrong=0))[0], TRUTH, atol=1e-3)


def test_matches_that_all_contradict_each_other_or_coincide_give_rigid_transforms() -> None:
    contradicting = as_matches(np.eye(3), 9 * np.eye(3))
    coinciding = as_matches(np.ones((5, 3)), np.ones((5, 3)))
    for matches in (contradicting, coinciding):
        for transformation in agreeing_transforms(matches):
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


# --- how well a transform agrees with matches ----------------------------------------------------------------------


def test_weights_fall_from_one_to_nothing_at_the_reach() -> None:
    reach = REACH * TOLERANCE
    misses = np.array([0.0, 0.1, 0.5, 0.99, 1.01, 50.0]) * reach
    source = np.random.default_rng(0).normal(size=(len(misses), 3))
    target = move(TRUTH, source) + misses[:, None] * np.array([0.6, 0.0, -0.8])
    weights = as_matches(source, target).weights(TRUTH)
    np.testing.assert_allclose(weights, (1 - (misses / reach) ** 2).clip(0), atol=1e-4)
    assert (weights[-2:] == 0).all()
    assert as_matches(source, target).support(TRUTH) == pytest.approx(4 / (6 + FEW))


def test_support_is_the_share_of_right_matches_and_little_where_there_are_few() -> None:
    matches = example((TRUTH, 100), wrong=900)
    assert matches.support(TRUTH) == pytest.approx(100 / (1000 + FEW), abs=0.01)
    assert matches.support(OTHER) < 0.02
    assert example((TRUTH, 5), wrong=0).support(TRUTH) < 0.1


def test_support_and_weights_move_along_and_swap() -> None:
    matches = example((TRUTH, 30), wrong=70)
    moved = as_matches(move(MOTION, matches.source.numpy()), matches.target.numpy())
    np.testing.assert_allclose(moved.weights(TRUTH @ np.linalg.inv(MOTION)), matches.weights(TRUTH), atol=1e-4)
    np.testing.assert_allclose(swapped(matches).weights(np.linalg.inv(TRUTH)), matches.weights(TRUTH), atol=1e-9)


def test_no_matches_support_nothing() -> None:
    nothing = as_matches(np.empty((0, 3)), np.empty((0, 3)))
    assert nothing.support(TRUTH) == 0.0
    assert nothing.weights(TRUTH).shape == (0,)


# --- matches of features -------------------------------------------------------------------------------------------


def distances(source: Tensor, target: Tensor) -> np.ndarray:
    return cdist(source.double().numpy(), target.double().numpy())


def mutual_by_definition(source: Tensor, target: Tensor, *, ties: bool) -> set[tuple[int, int]]:
    """Pairs with fewer than so many nearer on either side; of those that tie for the last place all, or none."""
    distance = distances(source, target)
    pairs = set()
    for i, j in np.ndindex(distance.shape):
        row, column = np.delete(distance[i], j), np.delete(distance[:, j], i)
        before = [(x < distance[i, j]) if ties else (x <= distance[i, j]) for x in (row, column)]
        if max(each.sum() for each in before) < RANK:
            pairs.add((i, j))
    return pairs


@pytest.mark.parametrize("shape", [(40, 30), (3, 50), (1, 1), (1, 5), (5, 1), (2, 2)])
def test_mutual_matches_are_those_of_the_definition(shape: tuple[int, int], generator: torch.Generator) -> None:
    source, target = (torch.randn(count, 33, generator=generator) for count in shape)
    pairs = mutual_matches(source, target)
    assert len(pairs) == len(set(map(tuple, pairs.tolist())))
    assert set(map(tuple, pairs.tolist())) == mutual_by_definition(source, target, ties=False)
    alike = distances(source, target)[tuple(pairs.numpy().T)]
    assert (np.diff(alike) > -1e-5).all()


@pytest.mark.parametrize("shape", [(12, 9), (9, 12), (1, 6)])
def test_of_features_that_tie_as_many_match_as_may(shape: tuple[int, int], generator: torch.Generator) -> None:
    source, target = (torch.randint(0, 2, (count, 2), generator=generator).float() for count in shape)
    pairs = set(map(tuple, mutual_matches(source, target).tolist()))
    assert mutual_by_definition(source, target, ties=False) <= pairs <= mutual_by_definition(source, target, ties=True)
    for side in (0, 1):
        assert max(np.bincount([pair[side] for pair in pairs])) <= RANK


def test_swapping_the_features_swaps_the_matches(generator: torch.Generator) -> None:
    source, target = torch.randn(40, 33, generator=generator), torch.randn(30, 33, generator=generator)
    np.testing.assert_array_equal(mutual_matches(target, source).flip(1), mutual_matches(source, target))


def test_no_more_matches_than_fit_and_those_most_alike(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    source, target = torch.randn(40, 33, generator=generator), torch.randn(30, 33, generator=generator)
    everything = mutual_matches(source, target)
    monkeypatch.setattr(consensus, "MATCHES", 7)
    np.testing.assert_array_equal(mutual_matches(source, target), everything[:7])


def bumpy(count: int, seed: int) -> np.ndarray:
    """Points on a closed surface without symmetry."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    waves = np.sin(5 * points @ np.array([0.6, 0.0, 0.8])) + np.cos(4 * points @ np.array([0.0, 1.0, 0.3]))
    return points * [1.0, 0.6, 0.4] * (0.8 + 0.15 * waves[:, None]) + 0.2 * np.maximum(points, 0)


def test_matched_features_are_points_of_the_clouds_and_agree_on_the_truth() -> None:
    source, target = bumpy(500, 1), move(TRUTH, bumpy(500, 1)[::-1])
    matches = match_features(source, target, 0.05)
    assert matches.source.shape == matches.target.shape
    assert len(matches.source) > 100
    assert matches.tolerance == pytest.approx(consensus.TOLERANCE * 0.05)
    for ends, cloud in ((matches.source, source), (matches.target, target)):
        assert cdist(ends.double().numpy(), cloud).min(1).max() < 1e-6
    assert matches.support(TRUTH) > 0.5
    np.testing.assert_allclose(agreeing_transforms(matches)[0], TRUTH, atol=1e-2)


def test_matches_are_the_same_in_any_pose_and_swapped() -> None:
    source, target = bumpy(400, 1), bumpy(350, 2)

    def found(a: np.ndarray, b: np.ndarray) -> set[tuple[int, int]]:
        matches = match_features(a, b, 0.06)
        ends = (cdist(matches.source.double(), a).argmin(1), cdist(matches.target.double(), b).argmin(1))
        return set(zip(*map(np.ndarray.tolist, ends), strict=True))

    pairs = found(source, target)
    assert {(i, j) for j, i in found(target, source)} == pairs
    # rounding decides here and there which bin an angle falls into
    moved = found(move(MOTION, source), target)
    assert len(moved & pairs) > 0.8 * len(moved | pairs)
