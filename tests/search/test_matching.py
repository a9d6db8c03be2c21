"""How alike the points of two clouds are: scores, mutual matches, and what they say of a transform."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from idam.clouds.pyramid import Level, level
from idam.errors import InputError
from idam.network.config import Config
from idam.network.features.invariant import Invariant, Surroundings, surroundings
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.search import matching as module
from idam.search.consensus import agreeing_transforms
from idam.search.matching import AGAINST, FEW, FOR, RANK, REACH, TOUCHING, FeatureMatches, Matching, mutual_matches
from idam.search.overlap import SAME_SURFACE
from matchings import NO_MATCHES, TOLERANCE, as_matches, bumpy, example, matching_by, scores_for, swapped
from motions import move, rigid

TRUTH = rigid([1.0, -1.5, 0.8], [0.1, 0.2, -0.3])
OTHER = rigid([-0.5, 0.9, 2.0], [-0.2, 0.0, 0.4])
MOTION = rigid([0.3, 2.0, -1.0], [0.5, -0.4, 0.2])
FAR = rigid([0.4, 0.2, -0.1], [9.0, 0.0, 0.0])
"""Where the clouds do not even touch."""
INVARIANT = Config(features="invariant", convolution=False, hybrid_elimination=False, iterations=1, blocks=1)
MODELS = ["general", "gnn-unseen-shapes"]
"""One of features that no pose changes, and one in whose place that one is asked."""


@pytest.fixture(scope="module")
def clouds() -> Level:
    """Two samplings of one surface; half of the second is missing, so that sizes differ."""
    target = bumpy(4000, 2)
    return level(bumpy(4000, 1), move(TRUTH, target[target[:, 0] > 0]), 500)


def moved(clouds: Level, motion: np.ndarray) -> Level:
    return Level(move(motion, clouds.source), clouds.target, clouds.spacing)


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
    elsewhere = as_matches(move(MOTION, matches.source.numpy()), matches.target.numpy())
    np.testing.assert_allclose(elsewhere.weights(TRUTH @ np.linalg.inv(MOTION)), matches.weights(TRUTH), atol=1e-4)
    np.testing.assert_allclose(swapped(matches).weights(np.linalg.inv(TRUTH)), matches.weights(TRUTH), atol=1e-9)


def test_no_matches_support_nothing() -> None:
    assert NO_MATCHES.support(TRUTH) == 0.0
    assert NO_MATCHES.weights(TRUTH).shape == (0,)


# --- mutual matches ------------------------------------------------------------------------------------------------


def mutual(score: Tensor) -> Tensor:
    return mutual_matches(score, score.logsumexp(1), score.logsumexp(0))


def as_set(pairs: Tensor) -> set[tuple[int, ...]]:
    return set(map(tuple, pairs.tolist()))


def mutual_by_definition(score: Tensor, *, ties: bool) -> set[tuple[int, ...]]:
    """Pairs with fewer than so many better on either side; of those that tie for the last place all, or none."""
    table = score.numpy()
    pairs: set[tuple[int, ...]] = set()
    for i, j in np.ndindex(*table.shape):
        others = np.delete(table[i], j), np.delete(table[:, j], i)
        before = [(x > table[i, j]) if ties else (x >= table[i, j]) for x in others]
        if max(each.sum() for each in before) < RANK:
            pairs.add((i, j))
    return pairs


def likelihood_by_definition(score: Tensor, i: int, j: int) -> float:
    """The pair's share of its row's softmax, times that of its column's."""
    table = score.double().exp().numpy()
    return float(table[i, j] / table[i].sum() * table[i, j] / table[:, j].sum())


@pytest.mark.parametrize("shape", [(40, 30), (3, 50), (1, 1), (1, 5), (5, 1), (2, 2)])
def test_mutual_matches_are_those_of_the_definition(shape: tuple[int, int], generator: torch.Generator) -> None:
    score = torch.randn(shape, generator=generator)
    pairs = mutual(score)
    assert len(pairs) == len(as_set(pairs))
    assert as_set(pairs) == mutual_by_definition(score, ties=False)


@pytest.mark.parametrize("shape", [(12, 9), (9, 12), (1, 6)])
def test_of_scores_that_tie_as_many_match_as_may(shape: tuple[int, int], generator: torch.Generator) -> None:
    score = torch.randint(0, 4, shape, generator=generator).float()
    pairs = as_set(mutual(score))
    assert mutual_by_definition(score, ties=False) <= pairs <= mutual_by_definition(score, ties=True)
    for side in (0, 1):
        assert max(np.bincount([pair[side] for pair in pairs])) <= RANK


def test_the_likeliest_match_comes_first(generator: torch.Generator) -> None:
    score = 3 * torch.randn(40, 30, generator=generator)
    likelihood = [likelihood_by_definition(score, i, j) for i, j in mutual(score).tolist()]
    assert len(set(likelihood)) > 20
    assert (np.diff(likelihood) < 1e-6).all()


def test_a_point_like_many_others_is_a_poor_match_to_all_of_them() -> None:
    score = torch.tensor([[9.0, 8.9, 8.8, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 4]])
    assert mutual(score)[:2].tolist() == [[3, 3], [0, 0]]


def test_swapping_the_sides_swaps_the_matches(generator: torch.Generator) -> None:
    score = torch.randn(40, 30, generator=generator)
    assert as_set(mutual(score.T).flip(1)) == as_set(mutual(score))


def test_no_more_matches_than_fit_and_those_the_likeliest(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    score = torch.randn(40, 30, generator=generator)
    everything = mutual(score)
    monkeypatch.setattr(module, "MATCHES", 7)
    assert len(everything) > 7
    np.testing.assert_array_equal(mutual(score), everything[:7])


# --- scores of features --------------------------------------------------------------------------------------------


def test_scores_are_inner_products_of_features_that_no_pose_changes(clouds: Level) -> None:
    network = IDAM(INVARIANT)
    assert isinstance(network.features, Invariant)
    features = [
        network.features.describe(surroundings(torch.as_tensor(cloud, dtype=torch.float32), clouds.spacing)).double()
        for cloud in (clouds.source, clouds.target)
    ]
    expected = torch.einsum("ik,jk->ij", *features) / math.sqrt(features[0].shape[1])
    matching = Matching.of(network, clouds)
    assert not matching.score.requires_grad
    np.testing.assert_allclose(matching.score, expected.detach(), atol=1e-4)


def test_a_network_of_the_paper_s_kind_leaves_matching_to_the_default_one(
    clouds: Level, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = IDAM()
    monkeypatch.setattr(network.features, "forward", lambda *_: pytest.fail("the network was asked"))
    np.testing.assert_array_equal(Matching.of(network, clouds).score, Matching.of(load_model(), clouds).score)


def test_a_network_of_the_paper_s_kind_may_name_the_model_to_match_by(clouds: Level) -> None:
    other = "practice-any-rotation"
    matching = Matching.of(IDAM(Config(matched_by=other)), clouds)
    np.testing.assert_array_equal(matching.score, Matching.of(load_model(other), clouds).score)
    with pytest.raises(InputError, match=r"^matched_by=gnn-practice: its features turn with the cloud; name a model"):
        Matching.of(IDAM(Config(matched_by="gnn-practice")), clouds)


@pytest.mark.parametrize("name", MODELS)
def test_rows_and_columns_are_summed_up(clouds: Level, name: str) -> None:
    matching = Matching.of(load_model(name), clouds)
    score = matching.score.double()
    assert score.shape == (len(clouds.source), len(clouds.target))
    np.testing.assert_allclose(matching.row, score.exp().sum(1).log(), atol=1e-4)
    np.testing.assert_allclose(matching.column, score.exp().sum(0).log(), atol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_matches_are_the_mutual_ones_and_agree_on_the_truth(clouds: Level, name: str) -> None:
    matching = Matching.of(load_model(name), clouds)
    rows, columns = mutual(matching.score).T.numpy()
    matches = matching.matches
    assert len(matches.source) > 100
    assert matches.tolerance == pytest.approx(module.TOLERANCE * clouds.spacing)
    np.testing.assert_allclose(matches.source, clouds.source[rows], atol=1e-6)
    np.testing.assert_allclose(matches.target, clouds.target[columns], atol=1e-6)
    assert matches.support(TRUTH) > 0.4
    np.testing.assert_allclose(agreeing_transforms(matches, 200)[0], TRUTH, atol=0.05)


def ends(matches: FeatureMatches, clouds: Level) -> set[tuple[int, int]]:
    """The matches as rows of both clouds."""
    rows = (cdist(matches.source.double(), clouds.source), cdist(matches.target.double(), clouds.target))
    return set(zip(*(distance.argmin(1).tolist() for distance in rows), strict=True))


@pytest.mark.parametrize("name", MODELS)
def test_matches_are_the_same_in_any_pose_and_swapped(clouds: Level, name: str) -> None:
    network = load_model(name)
    pairs = ends(Matching.of(network, clouds).matches, clouds)
    back = ends(Matching.of(network, clouds.swapped()).matches, clouds.swapped())
    assert {(i, j) for j, i in back} == pairs
    # rounding decides here and there which bin an angle falls into
    turned = ends(Matching.of(network, moved(clouds, MOTION)).matches, moved(clouds, MOTION))
    assert len(turned & pairs) > 0.8 * len(turned | pairs)


@pytest.mark.parametrize("config", [INVARIANT, Config()], ids=["invariant", "gnn"])
def test_any_number_of_threads_same_bits(clouds: Level, config: Config, one_thread: None) -> None:
    network = IDAM(config).eval()
    one = Matching.of(network, clouds)
    torch.set_num_threads(2)
    two = Matching.of(network, clouds)
    for name in ("score", "row", "column"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(one.matches.source, two.matches.source)
    np.testing.assert_array_equal(one.matches.target, two.matches.target)
    assert one.likelihood(TRUTH) == two.likelihood(TRUTH)


# --- what the scores say of a transform ----------------------------------------------------------------------------


def said_by_definition(clouds: Level, score: np.ndarray, transformation: np.ndarray) -> float:
    """Point by point, how much likelier than chance the similarity makes the target point it is laid on."""
    source, target = clouds.surfaces.source, clouds.surfaces.target
    total = 0.0
    for i, (point, normal) in enumerate(zip(source.points, source.normals, strict=True)):
        distance = np.linalg.norm(target.points - move(transformation, point), axis=1)
        j = int(distance.argmin())
        cosine = abs(target.normals[j] @ (transformation[:3, :3] @ normal))
        if distance[j] < TOUCHING * clouds.spacing and cosine >= SAME_SURFACE:
            by_row, by_column = (
                math.log(math.exp(score[i, j]) / np.exp(alike).mean()) for alike in (score[i], score[:, j])
            )
            total += min(max(min(by_row, by_column), AGAINST), FOR)
    return float(total / min(score.shape))


@pytest.mark.parametrize("transformation", [TRUTH, TRUTH @ rigid([0.5, 0.0, 0.0], [0.0, 0.0, 0.0]), OTHER])
@pytest.mark.parametrize("spread", [0.5, 5.0])
def test_likelihood_is_that_of_the_definition(
    clouds: Level, transformation: np.ndarray, spread: float, generator: torch.Generator
) -> None:
    score = spread * torch.randn(len(clouds.source), len(clouds.target), generator=generator)
    for way, scores, matrix in (
        (clouds, score, transformation),
        (clouds.swapped(), score.T, np.linalg.inv(transformation)),
    ):
        expected = said_by_definition(way, scores.double().numpy(), matrix)
        assert matching_by(way, scores).likelihood(matrix) == pytest.approx(expected, abs=1e-4)
        assert abs(expected) > 0.005


def test_nothing_is_said_of_a_transform_that_lays_nothing_together(clouds: Level) -> None:
    for score in (scores_for(clouds, TRUTH), scores_for(clouds, FAR)):
        assert matching_by(clouds, score).likelihood(FAR) == 0.0


@pytest.mark.parametrize("level_of_all", [0.0, -80.0, 500.0])
def test_points_like_all_others_say_nothing(clouds: Level, level_of_all: float) -> None:
    score = torch.full((len(clouds.source), len(clouds.target)), level_of_all)
    assert matching_by(clouds, score).likelihood(TRUTH) == pytest.approx(0.0, abs=1e-3)


def test_no_pair_of_points_says_more_than_so_much() -> None:
    cloud = level(bumpy(4000, 1), bumpy(4000, 1), 400)
    same = torch.eye(len(cloud.source))
    assert matching_by(cloud, 1e4 * same).likelihood(np.eye(4)) == pytest.approx(FOR)
    assert matching_by(cloud, -1e4 * same).likelihood(np.eye(4)) == pytest.approx(AGAINST)


def test_one_side_that_says_little_is_enough_to_say_little() -> None:
    cloud = level(bumpy(4000, 1), bumpy(4000, 1), 400)
    # the first target point is more like each source point than their own are, but each column has its own
    score = 9 * torch.eye(len(cloud.source))
    score[:, 0] = 20.0
    for way in (score, score.T):
        assert matching_by(cloud, way).likelihood(np.eye(4)) == pytest.approx(AGAINST, abs=0.05)


@pytest.mark.parametrize("name", MODELS)
def test_truth_is_likelier_than_wrong_contact(clouds: Level, name: str) -> None:
    matching = Matching.of(load_model(name), clouds)
    assert matching.likelihood(TRUTH) > 2.0
    for turn in ([0.5, 0.0, 0.0], [0.0, -0.6, 0.0], [0.0, 0.0, np.pi]):
        wrong = TRUTH @ rigid(turn, [0.0, 0.0, 0.0])
        assert matching.likelihood(wrong) < 0.5 * matching.likelihood(TRUTH)
    assert matching.likelihood(FAR) == 0.0


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_moves_along(clouds: Level, name: str) -> None:
    network = load_model(name)
    elsewhere = Matching.of(network, moved(clouds, MOTION))
    expected = Matching.of(network, clouds).likelihood(TRUTH)
    # rounding decides here and there which bin an angle falls into
    assert elsewhere.likelihood(TRUTH @ np.linalg.inv(MOTION)) == pytest.approx(expected, rel=0.02)
    assert elsewhere.likelihood(TRUTH) < 0.1 * expected


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_swaps_where_the_points_lie_one_on_one(name: str) -> None:
    points = level(bumpy(4000, 1), bumpy(4000, 2), 400).source
    clouds = Level(points[20:], move(TRUTH, points[:-60][::-1]), 0.08)
    network = load_model(name)
    forth = Matching.of(network, clouds).likelihood(TRUTH)
    assert forth > 2.0
    back = Matching.of(network, clouds.swapped()).likelihood(np.linalg.inv(TRUTH))
    assert back == pytest.approx(forth, abs=0.05)


# --- where the network runs ----------------------------------------------------------------------------------------


def test_features_are_described_where_the_network_is(clouds: Level, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: set[str] = set()

    def describe(_: Invariant, around: Surroundings) -> Tensor:
        seen.update(x.device.type for x in around)
        return torch.ones(len(around.points), Invariant.channels)

    monkeypatch.setattr(Invariant, "describe", describe)
    Matching.of(IDAM(INVARIANT).to("meta"), clouds)
    assert seen == {"meta"}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_says_the_same(clouds: Level) -> None:
    here, there = (Matching.of(load_model("general", device), clouds) for device in ("cpu", "cuda"))
    assert there.score.device.type == "cpu"
    np.testing.assert_allclose(there.score, here.score, atol=1e-2)
    assert there.likelihood(TRUTH) == pytest.approx(here.likelihood(TRUTH), abs=1e-2)
