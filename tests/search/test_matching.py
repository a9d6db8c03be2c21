"""How alike the points of two clouds are: scores, mutual matches, and what they say of a transform."""

from __future__ import annotations

import math

import numpy as np
import pytest

from idam.clouds.pyramid import PairLevel
from idam.clouds.surfaces import SAME_SURFACE, TOUCHING
from idam.describe.invariant import Surroundings
from idam.search import matching as module
from idam.search.consensus import agreeing_transforms
from idam.search.matching import AGAINST, FEW, FOR, MATCHES, REACH, FeatureMatches, Matching, mutual_matches
from idam.weights import load_descriptor
from matchings import NO_MATCHES, TOLERANCE, example, level, log_sum, matching_by, scores_for, swapped, thinned
from motions import move, rigid
from solids import bumpy, distances

TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
MOTION = rigid([0.3, 2.0, -1.0], [0.5, -0.4, 0.2])
FAR = rigid([0.4, 0.2, -0.1], [9.0, 0.0, 0.0])
"""Where the clouds do not even touch."""


@pytest.fixture(scope="module")
def clouds() -> PairLevel:
    """Two samplings of one surface; half of the second is missing, so that sizes differ."""
    target = thinned(bumpy(4000, 2), 500)
    return level(thinned(bumpy(4000, 1), 500), move(TRUTH, target[target[:, 0] > 0]))


@pytest.fixture(scope="module")
def matched(clouds: PairLevel) -> Matching:
    return Matching.of(load_descriptor(), clouds)


def exchanged(clouds: PairLevel) -> PairLevel:
    return level(clouds.target, clouds.source)


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


# --- how well a transform agrees with matches ----------------------------------------------------------------------


def test_weights_fall_from_one_to_nothing_at_the_reach() -> None:
    reach = REACH * TOLERANCE
    misses = np.array([0.0, 0.1, 0.5, 0.99, 1.01, 50.0]) * reach
    source = np.random.default_rng(0).normal(size=(len(misses), 3))
    target = move(TRUTH, source) + misses[:, None] * np.array([0.6, 0.0, -0.8])
    matches = FeatureMatches(source, target, TOLERANCE)
    weights = matches.weights(TRUTH)
    np.testing.assert_allclose(weights, (1 - (misses / reach) ** 2).clip(0), atol=1e-9)
    assert (weights[-2:] == 0).all()
    assert matches.support(TRUTH) == pytest.approx(4 / (6 + FEW))


def test_support_is_the_share_of_right_matches_and_little_where_there_are_few() -> None:
    matches = example((TRUTH, 100), wrong=900)
    assert matches.support(TRUTH) == pytest.approx(100 / (1000 + FEW), abs=0.01)
    assert matches.support(OTHER) < 0.02
    assert example((TRUTH, 5), wrong=0).support(TRUTH) < 0.1


def test_support_and_weights_move_along_and_swap() -> None:
    matches = example((TRUTH, 30), wrong=70)
    elsewhere = FeatureMatches(move(MOTION, matches.source), matches.target, TOLERANCE)
    np.testing.assert_allclose(elsewhere.weights(TRUTH @ np.linalg.inv(MOTION)), matches.weights(TRUTH), atol=1e-9)
    np.testing.assert_allclose(swapped(matches).weights(np.linalg.inv(TRUTH)), matches.weights(TRUTH), atol=1e-9)


def test_no_matches_support_nothing() -> None:
    assert NO_MATCHES.support(TRUTH) == 0.0
    assert NO_MATCHES.weights(TRUTH).shape == (0,)


# --- mutual matches ------------------------------------------------------------------------------------------------


def mutual(score: np.ndarray) -> list[tuple[int, int]]:
    score = score.astype(np.float32)
    i, j = mutual_matches(score, log_sum(score, 1), log_sum(score, 0))
    return list(zip(i.tolist(), j.tolist(), strict=True))


def mutual_by_definition(score: np.ndarray, *, ties: bool) -> set[tuple[int, int]]:
    """Pairs with fewer than two better on either side; of those that tie for the last place all, or none."""
    pairs: set[tuple[int, int]] = set()
    for i, j in np.ndindex(*score.shape):
        others = np.delete(score[i], j), np.delete(score[:, j], i)
        before = [(x > score[i, j]) if ties else (x >= score[i, j]) for x in others]
        if max(each.sum() for each in before) < 2:
            pairs.add((i, j))
    return pairs


def likelihood_by_definition(score: np.ndarray, i: int, j: int) -> float:
    """The pair's share of its row's softmax, times that of its column's."""
    table = np.exp(score)
    return float(table[i, j] / table[i].sum() * table[i, j] / table[:, j].sum())


@pytest.mark.parametrize("shape", [(40, 30), (3, 50), (1, 1), (1, 5), (5, 1), (2, 2)])
def test_mutual_matches_are_those_of_the_definition(shape: tuple[int, int], random: np.random.Generator) -> None:
    score = random.normal(size=shape)
    pairs = mutual(score)
    assert len(pairs) == len(set(pairs))
    assert set(pairs) == mutual_by_definition(score, ties=False)


@pytest.mark.parametrize("shape", [(12, 9), (9, 12), (1, 6)])
def test_of_scores_that_tie_as_many_match_as_may(shape: tuple[int, int], random: np.random.Generator) -> None:
    score = random.integers(0, 4, shape).astype(float)
    pairs = mutual(score)
    assert mutual_by_definition(score, ties=False) <= set(pairs) <= mutual_by_definition(score, ties=True)
    for side in (0, 1):
        assert max(np.bincount([pair[side] for pair in pairs])) <= 2


def test_the_likeliest_match_comes_first(random: np.random.Generator) -> None:
    score = 3 * random.normal(size=(40, 30))
    likelihood = [likelihood_by_definition(score, i, j) for i, j in mutual(score)]
    assert len(set(likelihood)) > 20
    assert (np.diff(likelihood) < 1e-6).all()


def test_a_point_like_many_others_is_a_poor_match_to_all_of_them() -> None:
    score = np.array([[9.0, 8.9, 8.8, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 4]])
    assert mutual(score)[:2] == [(3, 3), (0, 0)]


def test_swapping_the_sides_swaps_the_matches(random: np.random.Generator) -> None:
    score = random.normal(size=(40, 30))
    assert {(i, j) for j, i in mutual(score.T)} == set(mutual(score))


def test_no_more_matches_than_fit_and_those_the_likeliest(random: np.random.Generator) -> None:
    # each point is like one other, the less the later it comes
    score = np.diag(np.linspace(9, 5, MATCHES + 100))
    pairs = mutual(score[random.permutation(len(score))])
    assert len(pairs) == MATCHES
    assert {j for _, j in pairs} == set(range(MATCHES))


# --- scores of features --------------------------------------------------------------------------------------------


class Given:
    """A descriptor that gives what it is told, for the source and then for the target."""

    key = "given"

    def __init__(self, *features: np.ndarray) -> None:
        self.features = [x.astype(np.float32) for x in features]

    def describe(self, around: Surroundings) -> np.ndarray:
        return self.features.pop(0)


def test_scores_are_inner_products_of_features_over_the_root_of_their_length(random: np.random.Generator) -> None:
    source, target = random.normal(size=(60, 3)), random.normal(size=(40, 3))
    features = random.normal(size=(60, 16)), random.normal(size=(40, 16))
    matching = Matching.of(Given(*features), level(source, target))
    expected = np.einsum("ik,jk->ij", *features) / 4
    np.testing.assert_allclose(matching.score, expected, atol=1e-5)
    np.testing.assert_allclose(matching.row, np.log(np.exp(expected).sum(1)), atol=1e-5)
    np.testing.assert_allclose(matching.column, np.log(np.exp(expected).sum(0)), atol=1e-5)
    pairs = mutual(matching.score)
    np.testing.assert_array_equal(matching.matches.source, source[[i for i, _ in pairs]])
    np.testing.assert_array_equal(matching.matches.target, target[[j for _, j in pairs]])
    assert matching.matches.tolerance == module.TOLERANCE * matching.clouds.spacing


def test_matches_of_the_shipped_descriptor_agree_on_the_truth(matched: Matching) -> None:
    assert len(matched.matches.source) > 100
    assert matched.matches.support(TRUTH) > 0.35
    np.testing.assert_allclose(agreeing_transforms(matched.matches, 200)[0], TRUTH, atol=0.05)


def ends(matches: FeatureMatches, clouds: PairLevel) -> set[tuple[int, int]]:
    """The matches as rows of both clouds."""
    rows = (distances(matches.source, clouds.source), distances(matches.target, clouds.target))
    return set(zip(*(distance.argmin(1).tolist() for distance in rows), strict=True))


def test_matches_are_the_same_in_any_pose_and_swapped(clouds: PairLevel, matched: Matching) -> None:
    pairs = ends(matched.matches, clouds)
    other = exchanged(clouds)
    assert {(i, j) for j, i in ends(Matching.of(load_descriptor(), other).matches, other)} == pairs
    moved = level(move(MOTION, clouds.source), clouds.target)
    turned = ends(Matching.of(load_descriptor(), moved).matches, moved)
    # rounding decides here and there which bin an angle falls into
    assert len(turned & pairs) > 0.8 * len(turned | pairs)


# --- what the scores say of a transform ----------------------------------------------------------------------------


def said_by_definition(clouds: PairLevel, score: np.ndarray, transformation: np.ndarray) -> float:
    """Point by point, how much likelier than chance the similarity makes the target point it is moved to."""
    source, target = clouds.surfaces.source, clouds.surfaces.target
    total = 0.0
    for i, (point, normal) in enumerate(zip(source.points, source.normals, strict=True)):
        distance = np.linalg.norm(target.points - move(transformation, point), axis=1)
        j = int(distance.argmin())
        cosine = abs(target.normals[j] @ (transformation[:3, :3] @ normal))
        if distance[j] <= TOUCHING * clouds.spacing and cosine >= SAME_SURFACE:
            by_row, by_column = (
                math.log(math.exp(score[i, j]) / np.exp(alike).mean()) for alike in (score[i], score[:, j])
            )
            total += min(max(min(by_row, by_column), AGAINST), FOR)
    return float(total / min(score.shape))


@pytest.mark.parametrize("transformation", [TRUTH, TRUTH @ rigid([0.5, 0.0, 0.0], [0.0, 0.0, 0.0]), OTHER])
@pytest.mark.parametrize("spread", [0.5, 5.0])
def test_likelihood_is_that_of_the_definition(
    clouds: PairLevel, transformation: np.ndarray, spread: float, random: np.random.Generator
) -> None:
    score = spread * random.normal(size=(len(clouds.source), len(clouds.target)))
    for way, scores, matrix in (
        (clouds, score, transformation),
        (exchanged(clouds), score.T, np.linalg.inv(transformation)),
    ):
        expected = said_by_definition(way, scores, matrix)
        assert matching_by(way, scores).likelihood(matrix) == pytest.approx(expected, abs=1e-4)
        assert abs(expected) > 0.005


def test_nothing_is_said_of_a_transform_under_which_nothing_touches(clouds: PairLevel) -> None:
    for score in (scores_for(clouds, TRUTH), scores_for(clouds, FAR)):
        assert matching_by(clouds, score).likelihood(FAR) == 0.0


@pytest.mark.parametrize("level_of_all", [0.0, -80.0, 500.0])
def test_points_like_all_others_say_nothing(clouds: PairLevel, level_of_all: float) -> None:
    score = np.full((len(clouds.source), len(clouds.target)), level_of_all)
    assert matching_by(clouds, score).likelihood(TRUTH) == pytest.approx(0.0, abs=1e-3)


def test_no_pair_of_points_says_more_than_so_much() -> None:
    cloud = level(bumpy(400, 1), bumpy(400, 1))
    same = np.eye(400)
    assert matching_by(cloud, 1e4 * same).likelihood(np.eye(4)) == pytest.approx(FOR)
    assert matching_by(cloud, -1e4 * same).likelihood(np.eye(4)) == pytest.approx(AGAINST)


def test_one_side_that_says_little_is_enough_to_say_little() -> None:
    cloud = level(bumpy(400, 1), bumpy(400, 1))
    # the first target point is more like each source point than their own are, but each column has its own
    score = 9 * np.eye(400)
    score[:, 0] = 20.0
    for way in (score, score.T):
        assert matching_by(cloud, way).likelihood(np.eye(4)) == pytest.approx(AGAINST, abs=0.05)


def test_truth_is_likelier_than_wrong_contact(matched: Matching) -> None:
    assert matched.likelihood(TRUTH) > 1.5
    for turn in ([0.5, 0.0, 0.0], [0.0, -0.6, 0.0], [0.0, 0.0, np.pi]):
        wrong = TRUTH @ rigid(turn, [0.0, 0.0, 0.0])
        assert matched.likelihood(wrong) < 0.5 * matched.likelihood(TRUTH)
    assert matched.likelihood(FAR) == 0.0


def test_likelihood_moves_along(clouds: PairLevel, matched: Matching) -> None:
    elsewhere = Matching.of(load_descriptor(), level(move(MOTION, clouds.source), clouds.target))
    expected = matched.likelihood(TRUTH)
    # rounding decides here and there which bin an angle falls into
    assert elsewhere.likelihood(TRUTH @ np.linalg.inv(MOTION)) == pytest.approx(expected, rel=0.02)
    assert elsewhere.likelihood(TRUTH) < 0.1 * expected


def test_likelihood_swaps_where_the_points_lie_one_on_one() -> None:
    points = thinned(bumpy(4000, 1), 400)
    clouds = level(points[20:], move(TRUTH, points[:-60][::-1]))
    forth = Matching.of(load_descriptor(), clouds).likelihood(TRUTH)
    assert forth > 1.5
    back = Matching.of(load_descriptor(), exchanged(clouds)).likelihood(np.linalg.inv(TRUTH))
    assert back == pytest.approx(forth, rel=0.05)
