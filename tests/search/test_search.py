"""The search for the answer: what it matches, whom it asks, and what it makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist
from torch import Tensor

from idam import search as searching
from idam.clouds.pyramid import Level, Pyramid, build_pyramid, level
from idam.network.config import Config
from idam.network.model import IDAM, KeyPoints
from idam.network.pretrained import load_model
from idam.result import Matches
from idam.search.confidence import CLOSE, CONVERGED, Evidence, confidence
from idam.search.matching import Matching
from idam.search.ranking import Answer, alike
from idam.search.stages import (
    CONTENDERS,
    EXAMINED,
    SEEDS,
    STARTS,
    SURE,
    TAUGHT,
    Found,
    ask_once,
    examine,
    inverse,
    least_turned,
    ranked,
    search,
    settle,
)
from matchings import as_matches, matching_by, scores_for
from motions import move, rigid

TRUTH = rigid([1.0, -1.5, 0.8], [0.02, -0.01, 0.03])
FAR = rigid([0.4, 0.2, -0.1], [9.0, 0.0, 0.0])
"""Where the clouds do not even touch."""
WRONG = TRUTH @ rigid([0.0, 0.0, 1.5], [0.1, 0.0, 0.0])
"""Where they touch, but in the wrong places."""
INVARIANT = Config(features="invariant", convolution=False, hybrid_elimination=False, iterations=1, blocks=1)


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


@pytest.fixture(scope="module")
def steps() -> Pyramid:
    """Two samplings of one thing, few enough points to be quick, in levels that differ."""
    source, target = part(3000, seed=1), move(TRUTH, part(3000, seed=2))
    return Pyramid(level(source, target, 150), level(source, target, 700))


@pytest.fixture
def matched(monkeypatch: pytest.MonkeyPatch) -> list[Level]:
    """The clouds that are matched, in turn."""
    clouds: list[Level] = []
    of = Matching.of

    def noted(network: IDAM, level: Level) -> Matching:
        clouds.append(level)
        return of(network, level)

    monkeypatch.setattr(Matching, "of", noted)
    return clouds


@pytest.fixture
def speechless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Features say nothing: all points are alike, and none match."""
    monkeypatch.setattr(Matching, "of", lambda _, clouds: unspeaking(clouds))


def unspeaking(clouds: Level) -> Matching:
    return matching_by(clouds, torch.zeros(len(clouds.source), len(clouds.target)))


def same(levels: list[Level], expected: list[Level]) -> bool:
    return [*map(id, levels)] == [*map(id, expected)]


# --- what it matches -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", [Config(), INVARIANT], ids=["gnn", "invariant"])
def test_an_easy_pair_settles_on_small_clouds_without_the_network(
    easy: Pyramid, matched: list[Level], network: Config
) -> None:
    found = search(easy, Silent(network).eval(), np.eye(4), 0, "gicp")
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)
    assert confidence(found.evidence) >= SURE
    assert same(matched, [easy.small])


@pytest.mark.parametrize(
    ("confidences", "rounds"), [([0.96, 0.0], 1), ([SURE, 0.0], 1), ([SURE - 1e-6, 0.0], 2), ([0.1, 0.99], 2)]
)
def test_stops_where_it_is_sure_and_goes_on_to_larger_clouds_where_not(
    steps: Pyramid,
    matched: list[Level],
    monkeypatch: pytest.MonkeyPatch,
    confidences: list[float],
    rounds: int,
) -> None:
    said = iter(confidences)
    monkeypatch.setattr(searching, "confidence", lambda _: next(said))
    found = search(steps, Silent(INVARIANT).eval(), np.eye(4), 0, "none")
    assert same(matched, [steps.small, steps.larger][:rounds])
    # what it returns is what the last of them say
    assert cdist(found.matches.source, matched[-1].source).min(1).max() < 1e-6


def test_answers_have_to_stand_against_what_larger_clouds_say(
    steps: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = matching_by(steps.small, scores_for(steps.small, WRONG))
    larger = matching_by(steps.larger, scores_for(steps.larger, TRUTH))
    agreed = iter([[WRONG, TRUTH], []])
    monkeypatch.setattr(Matching, "of", lambda _, clouds: small if clouds is steps.small else larger)
    monkeypatch.setattr(searching, "agreeing_transforms", lambda *_: next(agreed))
    monkeypatch.setattr(searching, "propose", lambda *_: [FAR])
    monkeypatch.setattr(searching, "SURE", 2.0)
    found = search(steps, silent, FAR, 0, "none")
    np.testing.assert_array_equal(found.answers[0].transformation, TRUTH)
    np.testing.assert_array_equal(found.answers[1].transformation, WRONG)
    assert small.likelihood(WRONG) > small.likelihood(TRUTH)
    for answer in found.answers:
        assert answer.likelihood == larger.likelihood(answer.transformation)


def test_the_likeliest_answers_are_refined_and_larger_clouds_looked_into_more_closely(
    steps: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch, speechless: None
) -> None:
    turns = [rigid([0.0, 0.0, 0.2 * n], [0.0, 0.0, 0.3 * m]) for n in range(31) for m in range(5)]
    asked, looked_into = [], []

    def agreeing(_: object, seeds: int) -> list[np.ndarray]:
        asked.append(seeds)
        return turns

    def improve(answers: list[Answer], *_: object) -> list[Answer]:
        looked_into.append(len(answers))
        return answers

    monkeypatch.setattr(searching, "agreeing_transforms", agreeing)
    monkeypatch.setattr(searching, "improve", improve)
    search(steps, Silent(INVARIANT).eval(), FAR, 0, "gicp")
    assert asked == list(SEEDS)
    assert looked_into == [EXAMINED, EXAMINED]
    assert SEEDS[0] < SEEDS[1]


def test_all_matches_are_seeds_at_once_where_there_are_no_larger_clouds(
    steps: Pyramid, monkeypatch: pytest.MonkeyPatch, matched: list[Level]
) -> None:
    asked = []
    monkeypatch.setattr(searching, "agreeing_transforms", lambda _, seeds: asked.append(seeds) or [])
    monkeypatch.setattr(searching, "SURE", 2.0)
    search(replace(steps, all_small=True), Silent(INVARIANT).eval(), np.eye(4), 0, "none")
    assert same(matched, [steps.small])
    assert asked == [SEEDS[1]]


# --- whom it asks --------------------------------------------------------------------------------------------------


def test_an_unrelated_pair_asks_a_network_whose_features_turn_and_is_not_counted_on(
    unrelated: Pyramid, asked: Asked
) -> None:
    found = search(unrelated, asked, np.eye(4), 0, "gicp")
    assert asked.clouds
    assert confidence(found.evidence) < CONVERGED


def test_a_network_of_features_that_no_pose_changes_is_never_started_from_rotations(
    easy: Pyramid, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "SURE", 2.0)
    monkeypatch.setattr(searching, "propose", lambda *_: pytest.fail("the network was asked"))
    network = Silent(INVARIANT)
    network.load_state_dict(load_model("general").state_dict())
    found = search(easy, network.eval(), np.eye(4), 0, "gicp")
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)


def test_a_network_is_asked_last(
    steps: Pyramid, silent: IDAM, matched: list[Level], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "SURE", 2.0)
    before: list[Level] = []

    def propose(*_: object) -> list[np.ndarray]:
        before.extend(matched)
        return [FAR]

    monkeypatch.setattr(searching, "propose", propose)
    search(steps, silent, np.eye(4), 0, "none")
    assert same(before, [steps.small, steps.larger])
    assert same(matched, before)


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


def test_what_the_network_knows_wins_where_features_say_nothing(
    easy: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch, speechless: None
) -> None:
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    monkeypatch.setattr(searching, "propose", lambda *_: [np.eye(4), near, FAR])
    monkeypatch.setattr(searching, "SURE", 2.0)
    found = search(easy, silent, FAR, 0, "gicp")
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)
    assert found.matches.weight.shape == (0,)
    assert found.evidence.support == 0.0


def test_without_matches_or_network_the_guess_is_refined(
    easy: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch, speechless: None
) -> None:
    monkeypatch.setattr(searching, "SURE", 0.0)
    guess = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    (answer,) = search(easy, silent, guess, 0, "gicp").answers
    np.testing.assert_allclose(answer.transformation, TRUTH, atol=0.01)
    (answer,) = search(easy, silent, guess, 0, "none").answers
    np.testing.assert_array_equal(answer.transformation, guess)


def test_a_guess_is_considered_as_it_is(easy: Pyramid, silent: IDAM) -> None:
    found = search(easy, silent, TRUTH, 0, "none")
    np.testing.assert_array_equal(found.answers[0].transformation, TRUTH)


def test_nothing_is_looked_into_that_turns_too_far_from_the_guess(
    easy: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "SURE", 2.0)
    monkeypatch.setattr(searching, "propose", lambda *_: [TRUTH, WRONG])
    (answer,) = search(easy, silent, FAR, 0, "none", max_angle=20.0).answers
    np.testing.assert_array_equal(answer.transformation, FAR)
    some = rigid([0.0, 0.3, 0.0], [0.0, 0.0, 0.1])
    found = search(easy, silent, TRUTH @ some, 0, "gicp", max_angle=np.degrees(0.3) + 1)
    np.testing.assert_allclose(found.answers[0].transformation, TRUTH, atol=0.01)


def test_a_guess_far_off_does_no_harm(easy: Pyramid, silent: IDAM, found: Found) -> None:
    other = search(easy, silent, FAR, 0, "gicp")
    np.testing.assert_allclose(other.answers[0].transformation, found.answers[0].transformation, atol=1e-3)


@pytest.mark.parametrize("name", ["default", "gnn-unseen-shapes"])
def test_search_is_the_same_bits_every_time(unrelated: Pyramid, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "STARTS", 4)
    network = load_model(name)
    once, again = (search(unrelated, network, np.eye(4), 3, "gicp") for _ in range(2))
    np.testing.assert_array_equal(
        [answer.transformation for answer in once.answers], [answer.transformation for answer in again.answers]
    )
    assert once.evidence == again.evidence


# --- what it makes of the answers ----------------------------------------------------------------------------------


def test_answers_are_unlike_each_other_the_best_first(found: Found) -> None:
    scores = [answer.score for answer in found.answers]
    assert scores == sorted(scores, reverse=True)
    assert 1 <= len(scores) <= CONTENDERS
    for n, answer in enumerate(found.answers):
        assert not any(alike(answer.transformation, other.transformation) for other in found.answers[:n])


def test_ranked_sorts_and_keeps_the_better_of_two_that_are_alike() -> None:
    worse, better, other = Answer(np.eye(4), 0.3, 0.1), Answer(np.eye(4), 0.6, 0.1), Answer(FAR, 0.5, 0.1)
    assert ranked(iter([worse, other, better])) == [better, other]
    assert ranked([]) == []


def test_ties_stay_in_order() -> None:
    answers = [Answer(rigid([0.5 * n, 0.0, 0.0], [0.0, 0.0, 0.0]), 0.5, 0.1) for n in range(5)]
    assert ranked(answers) == answers


def turned(degrees: float, **figures: float) -> Answer:
    return Answer(rigid([0.0, 0.0, np.radians(degrees)], [0.0, 0.0, 0.0]), **figures)


def test_of_answers_as_good_as_the_best_the_one_nearest_to_the_guess_comes_first() -> None:
    best, turn, slight = turned(180, likelihood=1.0), turned(90, likelihood=0.98), turned(20, likelihood=0.95)
    worse = turned(0, likelihood=0.99 - CLOSE)
    assert least_turned([best, turn, slight, worse], np.eye(4)) == [slight, best, turn, worse]
    about = turned(100).transformation
    assert least_turned([best, turn, slight, worse], about) == [turn, best, slight, worse]
    assert least_turned([best], np.eye(4)) == [best]
    assert least_turned([best, worse], np.eye(4)) == [best, worse]


def test_a_symmetric_thing_is_turned_no_more_than_it_must_be(silent: IDAM) -> None:
    box = trimesh.creation.box((1.2, 0.8, 0.5))
    turn = rigid([0.0, 0.3, 0.2], [0.05, 0.0, 0.0])
    source, target = (np.asarray(trimesh.sample.sample_surface(box, 6000, seed=seed)[0]) for seed in (1, 2))
    clouds = Pyramid(*(level(source, move(turn, target), count) for count in (400, 1000)))
    for half_turn in (np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])):
        network = Silent(INVARIANT).eval()
        network.load_state_dict(load_model("general").state_dict())
        found = search(clouds, network, half_turn, 0, "gicp")
        np.testing.assert_allclose(found.answers[0].transformation, turn @ half_turn, atol=0.05)
        assert found.evidence.margin < CLOSE


@pytest.fixture(scope="module")
def prism() -> Pyramid:
    """A square prism, that four turns leave as it is: one by 40 degrees, another by -50."""
    box = trimesh.creation.box((0.8, 0.8, 1.1))
    source, target = (np.asarray(trimesh.sample.sample_surface(box, 900, seed=seed)[0]) for seed in (1, 2))
    return build_pyramid(source, move(about_z(40), target), None)


def about_z(degrees: float) -> np.ndarray:
    return rigid([0.0, 0.0, np.radians(degrees)], [0.0, 0.0, 0.0])


@pytest.mark.parametrize("exchanged", [False, True])
def test_of_poses_alike_the_network_chooses_among_those_it_was_taught(
    prism: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch, exchanged: bool
) -> None:
    def propose(_: IDAM, source: np.ndarray, *__: object) -> list[np.ndarray]:
        assert source is prism.small.source  # the caller's
        return [about_z(-44)]

    def chosen() -> Found:
        if exchanged:
            return search(prism.swapped(), silent, np.eye(4), 0, "symmetric", max_angle=TAUGHT).inverted()
        return search(prism, silent, np.eye(4), 0, "symmetric", max_angle=TAUGHT)

    monkeypatch.setattr(searching, "propose", propose)
    found = chosen()
    np.testing.assert_allclose(found.answers[0].transformation, about_z(-50), atol=0.05)
    # there is another, and the answer is no surer for being chosen
    assert any(np.allclose(other.transformation, about_z(40), atol=0.05) for other in found.answers[1:])
    assert found.evidence.margin < CLOSE
    monkeypatch.setattr(searching, "TAUGHT", TAUGHT - 1)
    monkeypatch.setattr(searching, "propose", lambda *_: [])
    np.testing.assert_allclose(chosen().answers[0].transformation, about_z(40), atol=0.05)


def test_the_network_turns_on_from_the_guess_whichever_cloud_is_matched_to_which(easy: Pyramid, asked: Asked) -> None:
    guess = rigid([0.5, -0.2, 0.1], [0.0, 0.0, 0.0])
    (there,) = ask_once(asked, easy, guess)
    (back,) = ask_once(asked, easy.swapped(), inverse(guess))
    np.testing.assert_allclose(inverse(back), there, atol=1e-6)
    source = torch.as_tensor(easy.small.source @ guess[:3, :3].T).float()
    seen = [cloud[0] for cloud in asked.clouds if cloud.shape[1:] == source.shape]
    assert sum(torch.allclose(cloud, source, atol=1e-6) for cloud in seen) == 2


def test_a_network_that_is_far_off_chooses_nothing(
    prism: Pyramid, silent: IDAM, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "propose", lambda *_: [rigid([0.9, 0.0, 0.0], [0.0, 0.3, 0.0])])
    found = search(prism, silent, np.eye(4), 0, "symmetric", max_angle=TAUGHT)
    np.testing.assert_allclose(found.answers[0].transformation, about_z(40), atol=0.05)


def test_settle_refines_and_scores(steps: Pyramid) -> None:
    near = rigid([0.03, 0.0, -0.02], [0.01, 0.0, 0.0]) @ TRUTH
    matching = matching_by(steps.small, scores_for(steps.small, TRUTH))
    best, *others = settle([Answer(FAR), Answer(np.eye(4)), Answer(near)], matching, 2.0, "gicp")
    np.testing.assert_allclose(best.transformation, TRUTH, atol=0.05)
    assert best.overlap > 0.8
    assert best.likelihood == matching.likelihood(best.transformation) > 1.0
    assert all(other.overlap < best.overlap for other in others)
    many = [Answer(rigid([0.0, 0.0, 0.3 * n], [0.0, 0.0, 0.3 * m])) for n in range(5) for m in range(5)]
    assert len(settle(many, matching, 2.0, "none")) == CONTENDERS


def matching_of(easy: Pyramid, right: int, wrong: int) -> Matching:
    """Of the matches some are right under the truth."""
    source = easy.small.source[: right + wrong]
    target = move(TRUTH, source)
    target[right:] += 5.0
    return replace(unspeaking(easy.small), matches=as_matches(source, target, 0.05))


@pytest.mark.parametrize(("right", "total"), [(30, 1.0), (0, 0.0)])
def test_weights_of_the_matches_sum_to_one_or_are_all_nothing(easy: Pyramid, right: int, total: float) -> None:
    found = examine([Answer(TRUTH, 0.9, right / 40)], matching_of(easy, right, 40 - right))
    assert found.matches.weight.shape == (40,)
    assert found.matches.weight.sum() == pytest.approx(total)
    assert (found.matches.weight[:right] > 0).all()
    assert not found.matches.weight[right:].any()
    assert found.matches.source.dtype == found.matches.target.dtype == np.float64


def test_evidence_is_that_of_the_first_answer_and_the_margin_of_the_only_one_is_whole(easy: Pyramid) -> None:
    matching = matching_of(easy, 20, 20)
    only = Answer(TRUTH, overlap=0.9, support=0.5, likelihood=2.5)
    assert examine([only], matching).evidence == Evidence(overlap=0.9, support=0.5, likelihood=2.5, margin=1.0)
    assert examine([only, Answer(FAR)], matching).evidence.margin == 1.0


def test_margin_is_how_much_less_the_next_best_scores_as_a_share(easy: Pyramid) -> None:
    matching = matching_of(easy, 20, 20)
    best, second, third = (Answer(rigid([x, 0, 0], [0, 0, 0]), likelihood=x) for x in (2.0, 0.5, 0.3))
    assert examine([best, second, third], matching).evidence.margin == pytest.approx(0.75)
    assert examine([best, third, second], matching).evidence.margin == pytest.approx(0.75)
    assert examine([best, replace(best, transformation=FAR)], matching).evidence.margin == 0.0
    # first because it turns least, though another is a little better
    assert examine([second, best], matching).evidence.margin == 0.0


def test_margin_is_nothing_where_nothing_touches(easy: Pyramid) -> None:
    for answers in ([Answer(FAR)], [Answer(FAR), Answer(np.eye(4))]):
        assert examine(answers, unspeaking(easy.small)).evidence.margin == 0.0


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
        assert answer.likelihood == other.likelihood
    assert back.matches.source is found.matches.target
    assert back.matches.target is found.matches.source
    assert back.matches.weight is found.matches.weight
    assert isinstance(back.matches, Matches)
    twice = back.inverted()
    np.testing.assert_allclose(twice.answers[0].transformation, found.answers[0].transformation, atol=1e-12)
