"""The search for the answer: what it matches, whom it asks, and what it makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idam.clouds.prepared import FINE, Prepared
from idam.clouds.pyramid import Pyramid
from idam.describe.invariant import Descriptor, Surroundings
from idam.search.judge import CONVERGED, confidence, evidence, weight
from idam.search.matching import FeatureMatches
from idam.search.ranking import Answer, same, scored
from idam.search.scope import Scope
from idam.search.stages import (
    APART,
    CLOSELY,
    CONTENDERS,
    EXAMINED,
    FIRMEST,
    MORE,
    STARVED,
    SURE,
    TAUGHT,
    TIED,
    VERIFIED,
    Found,
    Network,
    explain,
    first_of_its_kind,
    judged,
    proposals,
    search,
    smallest_rotation,
    to_match,
)
from idam.weights import load_descriptor
from matchings import level, matching_by, scores_for
from motions import degrees, move, rigid
from solids import box, boxes, bracket, torus

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
    descriptor: Descriptor | None = None,
) -> Found:
    return search(clouds, [descriptor or load_descriptor()], network, scope, method)


class Speechless:
    """Features of which all are alike."""

    key = "speechless"

    def describe(self, around: Surroundings) -> np.ndarray:
        return np.zeros((len(around.points), 4), np.float32)


def not_asked(guess: np.ndarray) -> np.ndarray:
    pytest.fail("the network was asked")


@pytest.fixture(scope="module")
def easy() -> Pyramid:
    """One sampling twice, with a little noise."""
    points = bracket(500, seed=1)
    return pyramid(points, move(TRUTH, points + np.random.default_rng(0).normal(0, 0.003, (500, 3))))


def street_and_a_part_of_it() -> tuple[Pyramid, Pyramid]:
    """Houses along a street as two clouds, and those of its houses in the middle on all of it."""
    random = np.random.default_rng(0)
    corners = random.uniform([-12, -3, 0], [12, 3, 0], (60, 3))
    sizes = random.uniform(0.2, 1.2, (60, 3))

    def scan(seed: int) -> np.ndarray:
        return boxes([(low, low + size) for low, size in zip(corners, sizes, strict=True)], 40_000, seed)

    one, other = scan(1), move(TRUTH, scan(2))
    middle = one[np.abs(one[:, 0]) < 1.5]
    return pyramid(one, other), pyramid(middle, other)


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


def test_a_part_of_a_scene_is_matched_at_its_own_scale_too() -> None:
    street, part = street_and_a_part_of_it()
    *coarser, finer = (level for level, _ in to_match(part, [Speechless()]))
    assert coarser == [part.small, part.larger]
    assert min(len(part.larger.source), len(part.larger.target)) < STARVED
    assert min(len(finer.source), len(finer.target)) > 2 * len(part.larger.source)
    assert max(len(finer.source), len(finer.target)) <= FINE
    assert look(part, descriptor=Speechless()).matching.clouds.source_level is finer.source_level
    assert [level for level, _ in to_match(street, [Speechless()])] == [street.small, street.larger]  # of one extent


def test_sparse_clouds_in_doubt_are_matched_by_other_features_too(easy: Pyramid, unrelated: Pyramid) -> None:
    first, second = Speechless(), load_descriptor()
    assert [by for _, by in to_match(easy, [first, second])] == [first, second]
    assert [by for _, by in to_match(unrelated, [first, second])] == [first, first]
    said = [
        confidence(search(easy, by, None, ALL, "symmetric").evidence) for by in ([first], [first, second], [second])
    ]
    assert said[0] < CONVERGED < SURE < said[1]
    assert said[1] == pytest.approx(said[2], abs=0.05)


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
    near = Scope(FAR, 20.0)
    answers = np.array([answer.transformation for answer in look(easy, near, "none").answers])
    assert len(near.within(answers)) == len(answers) > 0
    some = rigid([0.0, 0.3, 0.0], [0.0, 0.0, 0.1])
    found = look(easy, Scope(truth @ some, np.degrees(0.3) + 1))
    np.testing.assert_allclose(found.best, truth, atol=0.01)


@pytest.mark.parametrize("half_turn", [np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])])
def test_of_a_symmetric_object_s_poses_the_one_nearest_to_the_guess_comes_first(half_turn: np.ndarray) -> None:
    turn = rigid([0.0, 0.3, 0.2], [0.05, 0.0, 0.0])
    clouds = pyramid(box((1.2, 0.8, 0.5), 2500, seed=1), move(turn, box((1.2, 0.8, 0.5), 2500, seed=2)))
    found = look(clouds, Scope(half_turn))
    assert degrees(found.best, turn @ half_turn) < 3
    assert found.evidence.lead < TIED  # and it is hardly ahead of the others, if at all


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


@pytest.fixture(scope="module")
def without(prism: Pyramid) -> Found:
    """Without a network, chance says which of the prism's poses comes first."""
    return look(prism, Scope(np.eye(4), TAUGHT), "symmetric")


def test_of_poses_alike_the_network_chooses_among_those_it_was_taught(prism: Pyramid, without: Found) -> None:
    first, second = sorted((40.0, -50.0), key=lambda angle: degrees(without.best, about_z(angle)))
    np.testing.assert_allclose(without.best, about_z(first), atol=0.07)
    found = look(prism, Scope(np.eye(4), TAUGHT), "symmetric", network=lambda _: about_z(second + 6))
    np.testing.assert_allclose(found.best, about_z(second), atol=0.07)
    # there is another, and the answer is no surer for being chosen
    assert any(np.allclose(other.transformation, about_z(first), atol=0.07) for other in found.answers[1:])
    assert found.evidence.lead <= 0
    assert confidence(found.evidence) < CONVERGED


def test_a_network_that_is_far_off_chooses_nothing(prism: Pyramid, without: Found) -> None:
    off = rigid([0.9, 0.0, 0.0], [0.0, 0.3, 0.0])
    found = look(prism, Scope(np.eye(4), TAUGHT), "symmetric", network=lambda _: off)
    np.testing.assert_allclose(found.best, without.best, atol=1e-9)


# --- what it makes of the answers ----------------------------------------------------------------------------------


def test_answers_are_unlike_each_other_the_best_first(unrelated: Pyramid) -> None:
    found = look(unrelated)
    assert 1 < len(found.answers) <= CONTENDERS
    looked_at = [weight(answer) for answer in found.answers if answer.close > 0]
    assert looked_at[1:] == sorted(looked_at[1:], reverse=True)
    assert looked_at[0] >= max(looked_at) - TIED
    for n, answer in enumerate(found.answers):
        assert not any(same(answer.transformation, other.transformation) for other in found.answers[:n])


def turned(angle: float, likelihood: float) -> Answer:
    return Answer(about_z(angle), likelihood=likelihood)


def behind(best: Answer, logits: float, angle: float) -> Answer:
    """An answer that weighs so much less than another."""
    slope = weight(Answer(np.eye(4), support=1.0)) - weight(Answer(np.eye(4)))
    return replace(best, transformation=about_z(angle), support=best.support - logits / slope)


def test_of_answers_as_good_as_the_best_the_one_nearest_to_the_guess_comes_first() -> None:
    best = Answer(about_z(180), support=0.9, likelihood=1.0)
    turn, slight = behind(best, 0.4 * TIED, 90), behind(best, 0.9 * TIED, 20)
    worse = behind(best, 1.1 * TIED, 0)
    assert smallest_rotation([best, turn, slight, worse], np.eye(4)) == [slight, best, turn, worse]
    assert smallest_rotation([best, turn, slight, worse], about_z(100)) == [turn, best, slight, worse]
    assert smallest_rotation([best], np.eye(4)) == [best]
    assert smallest_rotation([best, worse], np.eye(4)) == [best, worse]
    # two attempts at one pose
    beside = behind(best, 0.4 * TIED, 180 - 0.9 * APART)
    assert smallest_rotation([best, beside], np.eye(4)) == [best, beside]


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


def test_evidence_is_what_the_judge_is_told_of_the_first_and_of_the_others(holding: Found) -> None:
    assert holding.evidence == evidence(holding.answers)
    other = Answer(FAR, overlap=0.8)
    two = replace(holding, answers=[*holding.answers, other])
    assert two.evidence.overlap == 0.9
    assert two.evidence.lead == pytest.approx(min(weight(holding.answers[0]) - weight(other), holding.evidence.lead))


def test_few_transforms_are_proposed_first_and_then_more_all_within_the_scope(holding: Found) -> None:
    scope = Scope(TRUTH, 60.0)
    (few, examined), (more, closely) = proposals(holding.matching, scope, seeds=20)
    assert (examined, closely) == (EXAMINED, CLOSELY)
    assert len(few) < len(more) <= 2 * MORE
    for transforms in (few, more):
        assert (scope.turned(transforms) <= np.radians(60) + 1e-6).all()
        assert same(TRUTH, transforms).any()


@pytest.fixture(scope="module")
def likely() -> Found:
    """Two samplings of one part, and features that know it."""
    clouds = level(bracket(500, seed=1), move(TRUTH, bracket(500, seed=2)))
    return Found([], matching_by(clouds, scores_for(clouds, TRUTH)))


def test_explained_are_the_likeliest_and_of_poses_alike_one(likely: Found) -> None:
    matching = likely.matching
    beside = TRUTH @ rigid([0.06, 0.0, 0.05], [0.01, 0.0, 0.0])
    off = TRUTH @ rigid([0.0, 0.0, 2.0], [0.0, 0.0, 0.0])
    found = explain(np.array([off, beside, TRUTH, FAR]), matching, ALL, "gicp", matching.clouds.surfaces, EXAMINED)
    np.testing.assert_allclose(found.best, TRUTH, atol=0.03)
    assert found.matching is matching
    for n, answer in enumerate(found.answers):
        assert not any(same(answer.transformation, other.transformation) for other in found.answers[:n])


def test_judged_are_ordered_by_weight_and_those_out_of_the_question_left_as_they_are(likely: Found) -> None:
    matching, fine = likely.matching, likely.matching.clouds.surfaces
    good = scored(TRUTH, matching, sparse=False)
    poor = scored(TRUTH @ rigid([0.0, 0.0, 2.0], [0.3, 0.0, 0.0]), matching, sparse=False)
    assert poor.score < 0.3 * good.score
    firm = [replace(good, transformation=FAR @ about_z(70 * n), contained=1.0, likelihood=-1.0) for n in range(FIRMEST)]
    first, *others, last = judged([good, poor, *firm], matching, "none", fine)
    assert first.close > 0
    assert last is poor
    # but for those that the surfaces speak for most
    assert len(others) == FIRMEST
    assert not any(answer is other for answer in others for other in firm)
    # they are weighed by what is seen closely
    slid = replace(good, transformation=TRUTH @ rigid([0.0, 0.0, 0.3], [0.1, 0.0, 0.0]), overlap=good.overlap - 0.01)
    answers = judged([replace(slid, likelihood=1.001 * good.likelihood), good], matching, "none", fine)
    assert len(answers) == 2
    assert all(answer.close > 0 for answer in answers)
    weights = [weight(answer) for answer in answers]
    assert weights == sorted(weights, reverse=True)


def test_judged_are_one_where_two_starts_end_in_one_pose(likely: Found) -> None:
    matching, fine = likely.matching, likely.matching.clouds.surfaces
    starts = [TRUTH @ rigid([0.0, 0.0, angle], [0.0, 0.0, 0.0]) for angle in (0.1, -0.1)]
    assert not same(*starts)
    answers = [scored(start, matching, sparse=False) for start in starts]
    (one,) = judged(answers, matching, "gicp", fine)
    np.testing.assert_allclose(one.transformation, TRUTH, atol=0.03)


def test_no_more_are_looked_at_closely_than_there_is_time_for(likely: Found) -> None:
    matching, fine = likely.matching, likely.matching.clouds.surfaces
    good = scored(TRUTH, matching, sparse=False)
    answers = [replace(good, transformation=about_z(50 * n)) for n in range(VERIFIED + 2)]
    found = judged(answers, matching, "none", fine)
    assert len(found) == len(answers)
    assert [answer is other for answer, other in zip(found[-2:], answers[-2:], strict=True)] == [True, True]
    assert not any(answer is other for answer in found[:VERIFIED] for other in answers)
