"""The search for the answer: what it matches, whom it asks, and what it makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from idam.search.confidence import CLOSE, CONVERGED, Evidence, confidence

from idam.clouds.prepared import Describes, Prepared
from idam.clouds.pyramid import Pyramid
from idam.search.matching import FeatureMatches
from idam.search.ranking import Answer, same
from idam.search.scope import Scope
from idam.search.stages import (
    CONTENDERS,
    SURE,
    TAUGHT,
    Found,
    Network,
    first_of_its_kind,
    least_turned,
    search,
)
from idam.weights import load_descriptor
from matchings import level, matching_by, scores_for
from motions import degrees, move, rigid
from solids import box, bracket, torus

TRUTH = rigid([1.0, -1.5, 0.8], [0.02, -0.01, 0.03])
FAR = rigid([0.4, 0.2, -0.1], [9.0, 0.0, 0.0])
"""Where the clouds do not even touch."""
ALL = Scope(np.eye(4))


def pyramid(source: np.ndarray, target: np.ndarray) -> Pyramid:
    return Pyramid(Prepared.of(source, "source"), Prepared.of(target, "target"))


def look(
    clouds: Pyramid,
    scope: Scope = ALL,
    method: str = "gicp",
    network: Network | None = None,
    descriptor: Describes | None = None,
) -> Found:
    return search(clouds, descriptor or load_descriptor(), network, scope, method)


def not_asked(guess: np.ndarray) -> np.ndarray:
    pytest.fail("the network was asked")


class Speechless:
    """Features of which all are alike."""

    key = "speechless"

    def __call__(self, points: np.ndarray, spacing: float) -> np.ndarray:
        return np.zeros((len(points), 4), np.float32)


@pytest.fixture(scope="module")
def easy() -> Pyramid:
    """One sampling twice, with a little noise."""
    points = bracket(500, seed=1)
    return pyramid(points, move(TRUTH, points + np.random.default_rng(0).normal(0, 0.003, (500, 3))))


@pytest.fixture(scope="module")
def truth(easy: Pyramid) -> np.ndarray:
    return easy.enter(TRUTH)


@pytest.fixture(scope="module")
def unrelated() -> Pyramid:
    return pyramid(bracket(1400, seed=1), torus(1400, 3, 0.7, 0.3))


@pytest.fixture(scope="module")
def found(easy: Pyramid) -> Found:
    return look(easy)


# --- what it matches -----------------------------------------------------------------------------------------------


def test_an_easy_pair_settles_on_small_clouds_without_the_network() -> None:
    source, target = bracket(3000, seed=1), move(TRUTH, bracket(3000, seed=2))
    clouds = pyramid(source, target)
    found = look(clouds, network=not_asked)
    np.testing.assert_allclose(clouds.leave(found.best), TRUTH, atol=0.02)
    assert confidence(found.evidence) >= SURE
    assert found.matching.clouds is clouds.small
    assert "larger" not in clouds.__dict__  # not even made


def test_an_unrelated_pair_is_matched_on_larger_clouds_and_not_counted_on(unrelated: Pyramid) -> None:
    found = look(unrelated)
    assert unrelated.larger.size > unrelated.small.size
    assert found.matching.clouds is unrelated.larger
    assert confidence(found.evidence) < CONVERGED


def test_where_the_small_clouds_hold_all_points_they_are_matched(easy: Pyramid, found: Found) -> None:
    assert easy.larger is easy.small
    assert found.matching.clouds is easy.small


def test_search_is_the_same_bits_every_time(unrelated: Pyramid) -> None:
    once, again = look(unrelated), look(Pyramid(unrelated.source, unrelated.target))
    for one, other in zip(once.answers, again.answers, strict=True):
        np.testing.assert_array_equal(one.transformation, other.transformation)
    assert once.evidence == again.evidence


# --- the guess and the scope ---------------------------------------------------------------------------------------


def test_a_guess_is_considered_as_it_is(easy: Pyramid, truth: np.ndarray) -> None:
    np.testing.assert_array_equal(look(easy, Scope(truth), "none").best, truth)


def test_a_guess_far_off_does_no_harm(easy: Pyramid, found: Found) -> None:
    np.testing.assert_allclose(look(easy, Scope(FAR)).best, found.best, atol=1e-3)


def test_without_matches_the_guess_is_refined(easy: Pyramid, truth: np.ndarray) -> None:
    guess = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ truth
    refined, unrefined = (look(easy, Scope(guess), method, descriptor=Speechless()) for method in ("gicp", "none"))
    np.testing.assert_allclose(refined.best, truth, atol=0.01)
    assert any((answer.transformation == guess).all() for answer in unrefined.answers)


def test_nothing_is_looked_into_that_turns_too_far_from_the_guess(easy: Pyramid, truth: np.ndarray) -> None:
    (answer,) = look(easy, Scope(FAR, 20.0), "none").answers
    np.testing.assert_array_equal(answer.transformation, FAR)
    some = rigid([0.0, 0.3, 0.0], [0.0, 0.0, 0.1])
    found = look(easy, Scope(truth @ some, np.degrees(0.3) + 1))
    np.testing.assert_allclose(found.best, truth, atol=0.01)


@pytest.mark.parametrize("half_turn", [np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])])
def test_of_a_symmetric_object_s_poses_the_one_nearest_to_the_guess_comes_first(half_turn: np.ndarray) -> None:
    turn = rigid([0.0, 0.3, 0.2], [0.05, 0.0, 0.0])
    clouds = pyramid(box((1.2, 0.8, 0.5), 2500, seed=1), move(turn, box((1.2, 0.8, 0.5), 2500, seed=2)))
    found = look(clouds, Scope(half_turn))
    assert degrees(found.best, turn @ half_turn) < 3
    assert found.evidence.margin < CLOSE


# --- a network -----------------------------------------------------------------------------------------------------


def test_a_network_is_asked_from_the_guess_where_nothing_is_sure(unrelated: Pyramid) -> None:
    asked = []

    def network(guess: np.ndarray) -> np.ndarray:
        asked.append(guess)
        return np.eye(4)

    found = look(unrelated, Scope(FAR), network=network)
    np.testing.assert_array_equal(asked, [FAR])
    assert confidence(found.evidence) < CONVERGED


def test_what_the_network_knows_wins_where_features_say_nothing(easy: Pyramid, truth: np.ndarray) -> None:
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ truth
    found = look(easy, Scope(FAR), network=lambda _: near, descriptor=Speechless())
    np.testing.assert_allclose(found.best, truth, atol=0.01)


def test_an_answer_of_the_network_s_that_is_out_of_scope_does_not_count(unrelated: Pyramid) -> None:
    scope = Scope(np.eye(4), 60.0)
    found = look(unrelated, scope, "none", network=lambda _: rigid([0.0, 2.0, 0.0], [0, 0, 0]))
    assert all(degrees(answer.transformation, np.eye(4)) <= 60.001 for answer in found.answers)
    for one, other in zip(found.answers, look(unrelated, scope, "none").answers, strict=True):
        np.testing.assert_array_equal(one.transformation, other.transformation)


@pytest.fixture(scope="module")
def prism() -> Pyramid:
    """A square prism, that four turns leave as it is: one by 40 degrees, another by -50."""
    return pyramid(box((0.8, 0.8, 1.1), 900, seed=1), move(about_z(40), box((0.8, 0.8, 1.1), 900, seed=2)))


def about_z(angle: float) -> np.ndarray:
    return rigid([0.0, 0.0, np.radians(angle)], [0.0, 0.0, 0.0])


def test_of_poses_alike_the_network_chooses_among_those_it_was_taught(prism: Pyramid) -> None:
    found = look(prism, Scope(np.eye(4), TAUGHT), "symmetric", network=lambda _: about_z(-44))
    np.testing.assert_allclose(found.best, about_z(-50), atol=0.07)
    # there is another, and the answer is no surer for being chosen
    assert any(np.allclose(other.transformation, about_z(40), atol=0.07) for other in found.answers[1:])
    assert found.evidence.margin < CLOSE
    without = look(prism, Scope(np.eye(4), TAUGHT), "symmetric")
    np.testing.assert_allclose(without.best, about_z(40), atol=0.07)


def test_a_network_that_is_far_off_chooses_nothing(prism: Pyramid) -> None:
    off = rigid([0.9, 0.0, 0.0], [0.0, 0.3, 0.0])
    found = look(prism, Scope(np.eye(4), TAUGHT), "symmetric", network=lambda _: off)
    np.testing.assert_allclose(found.best, about_z(40), atol=0.07)


# --- what it makes of the answers ----------------------------------------------------------------------------------


def test_answers_are_unlike_each_other_the_best_first(unrelated: Pyramid) -> None:
    found = look(unrelated)
    scores = [answer.score for answer in found.answers]
    assert 1 < len(scores) <= CONTENDERS
    assert scores[1:] == sorted(scores[1:], reverse=True)
    assert scores[0] >= (1 - CLOSE) * max(scores)
    for n, answer in enumerate(found.answers):
        assert not any(same(answer.transformation, other.transformation) for other in found.answers[:n])


def turned(angle: float, likelihood: float) -> Answer:
    return Answer(about_z(angle), likelihood=likelihood)


def test_of_answers_as_good_as_the_best_the_one_nearest_to_the_guess_comes_first() -> None:
    best, turn, slight = turned(180, 1.0), turned(90, 0.98), turned(20, 0.95)
    worse = turned(0, 0.99 - CLOSE)
    assert least_turned([best, turn, slight, worse], np.eye(4)) == [slight, best, turn, worse]
    assert least_turned([best, turn, slight, worse], about_z(100)) == [turn, best, slight, worse]
    assert least_turned([best], np.eye(4)) == [best]
    assert least_turned([best, worse], np.eye(4)) == [best, worse]


def test_of_answers_that_are_alike_the_first_stays() -> None:
    answers = [turned(0, 0.1), turned(5, 0.9), turned(60, 0.5), turned(58, 0.6)]
    assert first_of_its_kind(answers) == [answers[0], answers[2]]


@pytest.fixture(scope="module")
def holding() -> Found:
    """The truth, of sixty matches forty right."""
    points = bracket(400, seed=1) - 0.3
    clouds = level(points, move(TRUTH, points))
    target = move(TRUTH, points[:60])
    target[40:] += 5.0
    matching = matching_by(clouds, scores_for(clouds, TRUTH), FeatureMatches(points[:60], target, 0.05))
    return Found([Answer(TRUTH, overlap=0.9, support=0.5, likelihood=2.5)], matching)


def test_weights_of_the_matches_sum_to_one_or_are_all_nothing(holding: Found) -> None:
    assert holding.weights.shape == (60,)
    assert holding.weights.sum() == pytest.approx(1.0)
    assert (holding.weights[:40] > 0).all()
    assert not holding.weights[40:].any()
    nowhere = replace(holding, answers=[Answer(FAR)])
    np.testing.assert_array_equal(nowhere.weights, np.zeros(60))


def test_evidence_is_that_of_the_first_answer_and_the_margin_of_the_only_one_is_whole(holding: Found) -> None:
    assert holding.evidence == Evidence(overlap=0.9, support=0.5, likelihood=2.5, margin=1.0)
    assert replace(holding, answers=[*holding.answers, Answer(FAR)]).evidence.margin == 1.0


def test_margin_is_how_much_less_the_next_best_scores_as_a_share(holding: Found) -> None:
    def margin(*answers: Answer) -> float:
        return replace(holding, answers=list(answers)).evidence.margin

    best, second, third = (Answer(rigid([x, 0, 0], [0, 0, 0]), likelihood=x) for x in (2.0, 0.5, 0.3))
    assert margin(best, second, third) == margin(best, third, second) == pytest.approx(0.75)
    assert margin(best, replace(best, transformation=FAR)) == 0.0
    # first because it turns least, though another is a little better
    assert margin(second, best) == 0.0
    # nothing touches
    assert margin(Answer(FAR)) == margin(Answer(FAR), Answer(np.eye(4))) == 0.0


def test_refined_moves_the_best_and_drops_those_that_end_where_it_does(holding: Found) -> None:
    surfaces = holding.matching.clouds.surfaces
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    beside = TRUTH @ rigid([0.0, 0.2, 0.0], [0.02, 0.0, 0.0])
    other = TRUTH @ about_z(120)
    started = replace(holding, answers=[Answer(near, 0.5), Answer(beside, 0.4), Answer(other, 0.3)])
    refined = started.refined(surfaces, "point")
    np.testing.assert_allclose(refined.best, TRUTH, atol=1e-3)
    np.testing.assert_array_equal([a.transformation for a in refined.answers[1:]], [other])
    assert started.refined(surfaces, "none") is started
