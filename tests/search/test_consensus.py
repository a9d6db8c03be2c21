"""The transforms that sets of matches agree on."""

from __future__ import annotations

import numpy as np
import pytest

from idam.search.consensus import COMPANIONS, ROUNDS, agreeing_transforms, weighted_procrustes
from idam.search.matching import FeatureMatches
from matchings import TOLERANCE, example, swapped
from motions import any_rotation, move, rigid
from solids import distances

TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
MOTION = rigid([0.3, 2.0, -1.0], [0.5, -0.4, 0.2])
SEEDS = 200


@pytest.mark.parametrize("seed", range(5))
def test_truth_comes_first_though_nine_of_ten_matches_are_wrong(seed: int) -> None:
    first = agreeing_transforms(example((TRUTH, 30), wrong=270, seed=seed), SEEDS)[0]
    np.testing.assert_allclose(first, TRUTH, atol=1e-9)
    np.testing.assert_allclose(first[:3, :3] @ first[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(first[3], [0, 0, 0, 1])


def test_noise_within_the_tolerance_is_borne() -> None:
    matches = example((TRUTH, 60), wrong=240)
    noise = np.random.default_rng(1).normal(0, 0.2 * TOLERANCE, (len(matches.source), 3))
    noisy = FeatureMatches(matches.source, matches.target + noise, TOLERANCE)
    np.testing.assert_allclose(agreeing_transforms(noisy, SEEDS)[0], TRUTH, atol=0.02)


def test_the_larger_of_two_sets_comes_first_and_the_smaller_later() -> None:
    found = agreeing_transforms(example((OTHER, 25), (TRUTH, 40), wrong=150), SEEDS)
    off = np.abs(found[:, None] - [TRUTH, OTHER]).max((2, 3))
    assert off[0, 0] < 1e-9
    larger, smaller = (np.flatnonzero(off[:, n] < 1e-3) for n in (0, 1))
    assert len(smaller)
    assert larger.max() < smaller.min()


def test_moving_both_ends_moves_the_transform() -> None:
    matches = example((TRUTH, 30), wrong=270)
    moved = FeatureMatches(move(MOTION, matches.source), move(OTHER, matches.target), TOLERANCE)
    expected = OTHER @ TRUTH @ np.linalg.inv(MOTION)
    np.testing.assert_allclose(agreeing_transforms(moved, SEEDS)[0], expected, atol=1e-9)


def test_order_of_the_matches_does_not_matter() -> None:
    matches = example((TRUTH, 30), wrong=270)
    rows = np.random.default_rng(0).permutation(len(matches.source))
    shuffled = FeatureMatches(matches.source[rows], matches.target[rows], TOLERANCE)
    np.testing.assert_allclose(
        agreeing_transforms(shuffled, SEEDS)[0], agreeing_transforms(matches, SEEDS)[0], atol=1e-12
    )


def test_swapping_the_ends_inverts_the_transforms() -> None:
    matches = example((TRUTH, 40), (OTHER, 25), wrong=100)
    forth, back = agreeing_transforms(matches, SEEDS), agreeing_transforms(swapped(matches), SEEDS)
    assert len(forth) == len(back)
    np.testing.assert_allclose(np.linalg.inv(back[0]), forth[0], atol=1e-9)


@pytest.mark.parametrize("seeds", [1, 7])
def test_as_many_transforms_as_seeds_those_of_the_most_compatible_matches(seeds: int) -> None:
    found = agreeing_transforms(example((TRUTH, 30), wrong=270), seeds)
    assert found.shape == (seeds, 4, 4)
    np.testing.assert_allclose(found, np.broadcast_to(TRUTH, found.shape), atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_matches_agree_on_nothing(count: int) -> None:
    assert agreeing_transforms(example((TRUTH, count), wrong=0), SEEDS).shape == (0, 4, 4)


@pytest.mark.parametrize("count", [3, 4, 25])
def test_a_few_right_matches_are_enough(count: int) -> None:
    np.testing.assert_allclose(agreeing_transforms(example((TRUTH, count), wrong=0), SEEDS)[0], TRUTH, atol=1e-9)


def test_matches_that_all_contradict_each_other_or_coincide_give_rigid_transforms() -> None:
    contradicting = FeatureMatches(np.eye(3), 9 * np.eye(3), TOLERANCE)
    coinciding = FeatureMatches(np.ones((5, 3)), np.ones((5, 3)), TOLERANCE)
    for matches in (contradicting, coinciding):
        for transformation in agreeing_transforms(matches, SEEDS):
            rotation = transformation[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) > 0
            assert np.isfinite(transformation).all()


def procrustes_one_by_one(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The best rigid transform by sums over matches."""
    if not weight.sum():
        weight = np.ones(len(weight))
    weight = weight / weight.sum()
    p = sum(w * x for w, x in zip(weight, source, strict=True))
    q = sum(w * x for w, x in zip(weight, target, strict=True))
    covariance = sum(w * np.outer(a - p, b - q) for w, a, b in zip(weight, source, target, strict=True))
    u, _, vh = np.linalg.svd(covariance)
    rotation = vh.T @ np.diag([1, 1, np.linalg.det(vh.T @ u.T)]) @ u.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, q - rotation @ p
    return matrix


def agreeing_one_by_one(matches: FeatureMatches, seeds: int) -> list[np.ndarray]:
    """Second order compatibility as SC2-PCR defines it, seed by seed."""
    source, target = matches.source, matches.target
    count = len(source)
    compatible = np.abs(distances(source, source) - distances(target, target)) < matches.tolerance
    np.fill_diagonal(compatible, False)
    second_order = np.zeros((count, count))
    for i, j in zip(*np.nonzero(compatible), strict=True):
        second_order[i, j] = (compatible[i] & compatible[j]).sum()
    found = []
    for seed in sorted(range(count), key=lambda i: -second_order[i].sum())[:seeds]:
        best = sorted(range(count), key=lambda j: -second_order[seed, j])[:COMPANIONS]
        rows, weight = [seed, *best], second_order[seed][[best[0], *best]]
        matrix = procrustes_one_by_one(source[rows], target[rows], weight)
        for _ in range(ROUNDS):
            near = np.linalg.norm(move(matrix, source) - target, axis=1) < matches.tolerance
            matrix = procrustes_one_by_one(source, target, near.astype(float))
        near = np.linalg.norm(move(matrix, source) - target, axis=1) < matches.tolerance
        found.append((int(near.sum()), matrix))
    return [matrix for _, matrix in sorted(found, key=lambda each: -each[0])]


@pytest.mark.parametrize("wrong", [0, 8, 30])
def test_is_what_the_definition_gives_seed_by_seed(wrong: int) -> None:
    matches = example((TRUTH, 12), (OTHER, 9), wrong=wrong)
    found, expected = agreeing_transforms(matches, 15), np.array(agreeing_one_by_one(matches, 15))
    number, wanted = together(matches, found), together(matches, expected)
    np.testing.assert_array_equal(number, wanted)
    fixed = number >= 3  # two matches leave a rotation free
    assert fixed.sum() > 10
    np.testing.assert_allclose(found[fixed], expected[fixed], atol=1e-9)


def together(matches: FeatureMatches, transforms: np.ndarray) -> np.ndarray:
    """How many matches each transform brings together."""
    miss = [np.linalg.norm(move(matrix, matches.source) - matches.target, axis=1) for matrix in transforms]
    return (np.array(miss) < matches.tolerance).sum(1)


# --- Procrustes ----------------------------------------------------------------------------------------------------


@pytest.fixture
def problem() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Five noisy problems of thirty matches, and their weights."""
    random = np.random.default_rng(0)
    source = random.normal(size=(5, 30, 3))
    target = np.stack([x @ any_rotation(random).T + random.normal(size=3) for x in source])
    return source, target + random.normal(0, 0.3, target.shape), random.uniform(size=(5, 30))


def test_procrustes_is_that_of_sums_over_matches(problem: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    found = weighted_procrustes(*problem)
    expected = [procrustes_one_by_one(*each) for each in zip(*problem, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    source, target, weight = problem
    one = weighted_procrustes(source[0], target[0], weight)
    np.testing.assert_allclose(one, [procrustes_one_by_one(source[0], target[0], w) for w in weight], atol=1e-12)


def test_no_other_rigid_transform_misses_by_less(problem: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    random = np.random.default_rng(1)
    for source, target, weight, found in zip(*problem, weighted_procrustes(*problem), strict=True):
        changes = [rigid(1e-3 * random.normal(size=3), 1e-3 * random.normal(size=3)) for _ in range(50)]
        misses = [
            (weight * ((move(found @ change, source) - target) ** 2).sum(1)).sum() for change in [np.eye(4), *changes]
        ]
        assert min(misses[1:]) > misses[0]


def test_scale_of_the_weights_does_not_matter_and_none_at_all_count_as_equal(
    problem: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    source, target, weight = problem
    found = weighted_procrustes(source, target, weight)
    np.testing.assert_allclose(weighted_procrustes(source, target, 1e6 * weight), found, atol=1e-12)
    equal = weighted_procrustes(source, target, np.ones_like(weight))
    np.testing.assert_allclose(weighted_procrustes(source, target, np.zeros_like(weight)), equal, atol=1e-12)


def test_a_mirrored_cloud_is_not_mirrored_back(problem: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    source, _, weight = problem
    for matrix in weighted_procrustes(source, source * [1, 1, -1], weight):
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
