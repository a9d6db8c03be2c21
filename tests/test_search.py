"""The search for the answer: what it asks, and what it makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from idam import search as searching
from idam.confidence import CONVERGED, confidence
from idam.consensus import FeatureMatches
from idam.network.model import IDAM, KeyPoints
from idam.network.pretrained import load_model
from idam.pyramid import Pyramid, build_pyramid
from idam.ranking import Answer, alike
from idam.result import Matches
from idam.search import HYPOTHESES, STARTS, Found, examine, inverse, ranked, search, settle
from motions import move, rigid

TRUTH = rigid([1.0, -1.5, 0.8], [0.02, -0.01, 0.03])
FAR = rigid([0.4, 0.2, -0.1], [9.0, 0.0, 0.0])
"""Where the clouds do not even touch."""


def part(count: int, seed: int) -> np.ndarray:
    """Points on a part without symmetry, about the unit sphere."""
    corners = [([0, 0, 0], [1, 0.5, 0.12]), ([0, 0, 0.12], [0.15, 0.5, 0.82]), ([0.55, 0.1, 0.12], [0.8, 0.3, 0.47])]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in corners])
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])
    return (points - [0.4, 0.25, 0.2]) / 0.7


def torus(count: int) -> np.ndarray:
    return np.asarray(trimesh.sample.sample_surface(trimesh.creation.torus(0.7, 0.3), count, seed=3)[0])


class Silent(IDAM):
    """A network that is not to be asked."""

    def eliminate(self, points: Tensor, features: Tensor, keep: float | None = None) -> KeyPoints:
        pytest.fail("the network was asked")


class Asked(IDAM):
    """A network, untrained, that notes what it is asked."""

    clouds: list[Tensor]

    def eliminate(self, points: Tensor, features: Tensor, keep: float | None = None) -> KeyPoints:
        self.clouds.append(points)
        return super().eliminate(points, features, keep)


@pytest.fixture
def silent() -> IDAM:
    return Silent().eval()


@pytest.fixture
def asked() -> Asked:
    network = Asked().eval()
    network.clouds = []
    return network


@pytest.fixture(scope="module")
def easy() -> Pyramid:
    """One sampling twice, with a little noise."""
    points = part(500, seed=1)
    return build_pyramid(points, move(TRUTH, points) + np.random.default_rng(0).normal(0, 0.003, (500, 3)), None)


@pytest.fixture(scope="module")
def unrelated() -> Pyramid:
    return build_pyramid(part(400, seed=1), torus(400), None)


@pytest.fixture(scope="module")
def found(easy: Pyramid) -> Found:
    return search(easy, Silent().eval(), np.eye(4), 0, "gicp")


# --- whom it asks --------------------------------------------------------------------------------------------------


def test_an_easy_pair_settles_without_the_network(found: Found) -> None:
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)
    assert confidence(found.evidence) > 0.95


def test_an_unrelated_pair_asks_the_network_and_is_not_counted_on(unrelated: Pyramid, asked: Asked) -> None:
    found = search(unrelated, asked, np.eye(4), 0, "gicp")
    assert asked.clouds
    assert confidence(found.evidence) < CONVERGED


def test_network_sees_the_small_clouds_from_many_rotations(
    easy: Pyramid, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "SURE", 2.0)
    search(easy, asked, np.eye(4), 0, "none")
    target, source = sorted((cloud for cloud in asked.clouds), key=len)
    assert source.shape == (STARTS, len(easy.small.source), 3)
    np.testing.assert_allclose(source[0], easy.small.source, atol=1e-6)
    np.testing.assert_allclose(target[0], easy.small.target, atol=1e-6)


def test_network_starts_turn_around_the_guess(easy: Pyramid, asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "SURE", 2.0)
    search(easy, asked, FAR, 0, "none")
    source = max(asked.clouds, key=len)
    np.testing.assert_allclose(source[0], easy.small.source @ FAR[:3, :3].T, atol=1e-6)


NONE = FeatureMatches(torch.empty(0, 3), torch.empty(0, 3), 0.1)


def test_what_the_network_knows_wins_where_features_say_nothing(
    easy: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "match_features", lambda *_: NONE)
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    monkeypatch.setattr(searching, "propose", lambda *_: [np.eye(4), near, FAR])
    monkeypatch.setattr(searching, "SURE", 2.0)
    found = search(easy, silent, FAR, 0, "gicp")
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)
    assert found.matches.weight.shape == (0,)
    assert found.evidence.support == 0.0


def test_without_matches_or_network_the_guess_is_refined(
    easy: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "match_features", lambda *_: NONE)
    monkeypatch.setattr(searching, "SURE", 0.0)
    guess = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    (answer,) = search(easy, silent, guess, 0, "gicp").answers
    np.testing.assert_allclose(answer.transformation, TRUTH, atol=0.01)
    (answer,) = search(easy, silent, guess, 0, "none").answers
    np.testing.assert_array_equal(answer.transformation, guess)


def test_a_guess_is_considered_as_it_is(easy: Pyramid, silent: IDAM) -> None:
    found = search(easy, silent, TRUTH, 0, "none")
    np.testing.assert_array_equal(found.answers[0].transformation, TRUTH)


def test_a_guess_far_off_does_no_harm(easy: Pyramid, silent: IDAM, found: Found) -> None:
    other = search(easy, silent, FAR, 0, "gicp")
    np.testing.assert_allclose(other.answers[0].transformation, found.answers[0].transformation, atol=1e-3)


def test_search_is_the_same_bits_every_time(unrelated: Pyramid) -> None:
    network = load_model()
    once, again = (search(unrelated, network, np.eye(4), 3, "gicp") for _ in range(2))
    np.testing.assert_array_equal(
        [answer.transformation for answer in once.answers], [answer.transformation for answer in again.answers]
    )
    assert once.evidence == again.evidence


# --- what it makes of the answers ----------------------------------------------------------------------------------


def test_answers_are_unlike_each_other_the_best_first(found: Found) -> None:
    scores = [answer.score for answer in found.answers]
    assert scores == sorted(scores, reverse=True)
    assert 1 <= len(scores) <= HYPOTHESES
    for n, answer in enumerate(found.answers):
        assert not any(alike(answer.transformation, other.transformation) for other in found.answers[:n])


def test_ranked_sorts_and_keeps_the_better_of_two_that_are_alike() -> None:
    worse, better, other = Answer(np.eye(4), 0.3, 0.1), Answer(np.eye(4), 0.6, 0.1), Answer(FAR, 0.5, 0.1)
    assert ranked(iter([worse, other, better])) == [better, other]
    assert ranked([]) == []


def test_ties_stay_in_order() -> None:
    answers = [Answer(rigid([0.5 * n, 0.0, 0.0], [0.0, 0.0, 0.0]), 0.5, 0.1) for n in range(5)]
    assert ranked(answers) == answers


def test_settle_refines_and_scores_on_the_dense_clouds(easy: Pyramid) -> None:
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    best, *others = settle([Answer(FAR), Answer(np.eye(4)), Answer(near)], easy, NONE, 2.0, "gicp")
    np.testing.assert_allclose(best.transformation, TRUTH, atol=0.01)
    assert best.overlap > 0.9
    assert all(other.overlap < best.overlap for other in others)


def matches_of(easy: Pyramid, right: int, wrong: int) -> FeatureMatches:
    source = torch.as_tensor(easy.small.source[: right + wrong], dtype=torch.float32)
    target = torch.as_tensor(move(TRUTH, source.double().numpy()), dtype=torch.float32)
    target[right:] += 5.0
    return FeatureMatches(source, target, 0.05)


@pytest.mark.parametrize(("right", "total"), [(30, 1.0), (0, 0.0)])
def test_weights_of_the_matches_sum_to_one_or_are_all_nothing(easy: Pyramid, right: int, total: float) -> None:
    found = examine([Answer(TRUTH, 0.9, right / 40)], matches_of(easy, right, 40 - right))
    assert found.matches.weight.shape == (40,)
    assert found.matches.weight.sum() == pytest.approx(total)
    assert (found.matches.weight[:right] > 0).all()
    assert not found.matches.weight[right:].any()
    assert found.matches.source.dtype == found.matches.target.dtype == np.float64


def test_margin_of_the_only_answer_is_whole(easy: Pyramid) -> None:
    matches = matches_of(easy, 20, 20)
    only = Answer(TRUTH, 0.9, 0.5)
    evidence = examine([only], matches).evidence
    assert (evidence.overlap, evidence.support, evidence.margin) == (0.9, 0.5, 1.0)
    assert examine([only, Answer(FAR)], matches).evidence.margin == 1.0


def test_margin_is_how_much_less_the_second_scores_as_a_share(easy: Pyramid) -> None:
    matches = matches_of(easy, 20, 20)
    best = Answer(TRUTH, 0.8, 0.5)
    answers = [best, Answer(FAR, 0.2, 0.5), Answer(np.eye(4), 0.1, 0.5)]
    assert examine(answers, matches).evidence.margin == pytest.approx(0.75)
    assert examine([best, replace(best, transformation=FAR)], matches).evidence.margin == 0.0


def test_margin_is_nothing_where_nothing_touches(easy: Pyramid) -> None:
    assert examine([Answer(FAR)], NONE).evidence.margin == 0.0
    assert examine([Answer(FAR), Answer(np.eye(4))], NONE).evidence.margin == 0.0


# --- the other way round -------------------------------------------------------------------------------------------


def test_inverse_undoes_a_transform() -> None:
    np.testing.assert_allclose(inverse(TRUTH) @ TRUTH, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(inverse(FAR), np.linalg.inv(FAR), atol=1e-12)
    np.testing.assert_array_equal(inverse(FAR)[3], [0, 0, 0, 1])


def test_inverted_exchanges_source_and_target(found: Found) -> None:
    back = found.inverted()
    assert back.evidence == found.evidence
    for answer, other in zip(back.answers, found.answers, strict=True):
        np.testing.assert_allclose(answer.transformation, np.linalg.inv(other.transformation), atol=1e-12)
        assert (answer.overlap, answer.support) == (other.overlap, other.support)
    assert back.matches.source is found.matches.target
    assert back.matches.target is found.matches.source
    assert back.matches.weight is found.matches.weight
    assert isinstance(back.matches, Matches)
    twice = back.inverted()
    np.testing.assert_allclose(twice.answers[0].transformation, found.answers[0].transformation, atol=1e-12)
