"""From many transforms to few answers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from idam.align import TOUCHING
from idam.clouds.pyramid import Level
from idam.search.matching import FEW, Matching
from idam.search.overlap import agreement
from idam.search.ranking import UNLIKELY, Answer, alike, distinct, improve, likeliest
from matchings import as_matches, matching_by, scores_for


def rigid(degrees: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """A turn about some axis and a shift along some other."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    matrix[:3, 3] = shift * np.array([0.0, 0.8, -0.6])
    return matrix


# --- like answers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degrees", "shift", "same"),
    [(0, 0, True), (9.9, 0, True), (10.1, 0, False), (180, 0, False), (0, 0.099, True), (0, 0.101, False)],
)
def test_alike(degrees: float, shift: float, same: bool) -> None:
    base = rigid(77.0, 0.4)
    # turned after the shift is undone, so that the source's centre goes to the same place
    other = base.copy()
    other[:3, :3] = rigid(degrees)[:3, :3] @ base[:3, :3]
    other[:3, 3] += rigid(shift=shift)[:3, 3]
    assert alike(base, other) is same
    assert alike(other, base) is same


def test_distinct_keeps_the_first_of_those_that_are_alike() -> None:
    turned, nearly = rigid(90), rigid(94)
    answers = [
        Answer(rigid(0), 0.9),
        Answer(turned, 0.2),
        Answer(rigid(5), 0.7),
        Answer(rigid(90, 0.5), 0.6),
        Answer(nearly, 0.5),
        Answer(rigid(-6), 0.4),
    ]
    kept = distinct(iter(answers))
    assert [a.overlap for a in kept] == [0.9, 0.2, 0.6]
    assert kept[1].transformation is turned


def test_distinct_stops_at_as_many_as_asked_for() -> None:
    answers = (Answer(rigid(20 * n if n < 4 else pytest.fail("looked further")), 1 - n / 10) for n in range(6))
    assert [a.overlap for a in distinct(answers, 3)] == pytest.approx([1.0, 0.9, 0.8])
    assert len(distinct([Answer(rigid(20 * n)) for n in range(3)], 7)) == 3


def test_distinct_answers_stay_as_they_are() -> None:
    answers = [Answer(rigid(30 * n), 1 - n / 10) for n in range(6)]
    assert distinct(answers) == answers
    assert distinct([]) == []


# --- the score -----------------------------------------------------------------------------------------------------


def test_score_grows_with_likelihood_and_with_overlap() -> None:
    for fixed in (0.0, 0.5, 1.0):
        by_likelihood = [Answer(rigid(), overlap=fixed, likelihood=x).score for x in np.linspace(0, 4, 11)]
        by_overlap = [Answer(rigid(), overlap=x, likelihood=4 * fixed).score for x in np.linspace(0, 1, 11)]
        assert by_likelihood == sorted(set(by_likelihood))
        assert by_overlap == sorted(set(by_overlap))


def test_features_that_speak_against_an_answer_count_as_saying_nothing() -> None:
    against, silent = (Answer(rigid(), overlap=0.8, likelihood=x).score for x in (-2.0, 0.0))
    assert against == silent == pytest.approx(UNLIKELY * 0.8)
    assert Answer(rigid()).score == 0.0


def test_wrong_contact_ranks_below_less_overlap_of_points_that_are_alike() -> None:
    assert Answer(rigid(), overlap=0.9, likelihood=0.02).score < Answer(rigid(), overlap=0.2, likelihood=0.2).score
    # and between answers of which the features say nothing, overlap decides
    assert Answer(rigid(), overlap=0.2, likelihood=-0.1).score < Answer(rigid(), overlap=0.4, likelihood=-0.5).score


def test_support_is_for_the_confidence_alone() -> None:
    assert Answer(rigid(), 0.5, support=0.0, likelihood=1.0).score == Answer(rigid(), 0.5, 1.0, 1.0).score


# --- improving -----------------------------------------------------------------------------------------------------


def boxes(count: int, seed: int) -> np.ndarray:
    """Points on three unlike boxes."""
    corners = [([0, 0, 0], [1, 0.6, 0.2]), ([0, 0, 0.2], [0.2, 0.6, 0.8]), ([0.6, 0.1, 0.2], [0.9, 0.3, 0.5])]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in corners])
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0]) - 0.3


@pytest.fixture(scope="module")
def matching() -> Matching:
    """Two samplings of one thing in one pose: two of three matches are right under the identity, and so are scores."""
    points = np.random.default_rng(0).normal(size=(30, 3))
    wrong = np.array([0.0, 0.0, 0.0, 0.0, 5.0, 5.0]).repeat(5)[:, None]
    clouds = Level(boxes(800, seed=1), boxes(800, seed=2), 0.03)
    return matching_by(clouds, scores_for(clouds, rigid()), as_matches(points, points + wrong, 0.045))


STARTS = [rigid(170), rigid(6, 0.05), rigid(), rigid(60, 0.3)]


def test_improve_without_refinement_only_scores(matching: Matching) -> None:
    clouds = matching.clouds
    found = improve([Answer(start, overlap=7.0) for start in STARTS], matching, 4.0, "none")
    assert len(found) == len(STARTS)
    for a, start in zip(found, STARTS, strict=True):
        assert (a.transformation == start).all()
        assert a.support == matching.matches.support(start)
        assert a.likelihood == matching.likelihood(start)
        expected = agreement(clouds.surfaces.source, clouds.surfaces.target, start, TOUCHING * clouds.spacing)
        assert a.overlap == expected.score
    assert max(found, key=lambda a: a.score) is found[2]
    assert found[2].support == pytest.approx(20 / (30 + FEW))


def test_improve_refines_each_and_scores_what_it_refined(matching: Matching) -> None:
    unrefined, refined = (improve(list(map(Answer, STARTS)), matching, 4.0, m) for m in ("none", "gicp"))
    assert len(refined) == len(STARTS)
    assert refined[1].overlap > 0.7 > 0.5 > unrefined[1].overlap
    assert refined[1].support == pytest.approx(20 / (30 + FEW))
    assert refined[1].likelihood > unrefined[1].likelihood + 0.3
    # the truth itself, and the one that started near it
    for a in refined[1:3]:
        assert np.degrees(Rotation.from_matrix(a.transformation[:3, :3]).magnitude()) < 1.0
        assert np.linalg.norm(a.transformation[:3, 3]) < 0.01
    assert len(distinct(refined)) == len(STARTS) - 1
    assert not alike(refined[-1].transformation, np.eye(4))


def test_refinement_reaches_only_so_far(matching: Matching) -> None:
    start = Answer(rigid(6, 0.05))
    near, far = (improve([start], matching, reach, "gicp")[0].overlap for reach in (0.3, 4.0))
    assert near < 0.6 < 0.7 < far


def test_nothing_to_improve(matching: Matching) -> None:
    assert improve([], matching, 4.0, "gicp") == []


def test_the_likeliest_come_first_and_no_more_than_asked_for(matching: Matching) -> None:
    answers = [Answer(rigid(degrees, 0.01 * degrees)) for degrees in (40, 3, 170, 0, 9)]
    kept = likeliest(answers, matching, 3)
    assert kept == [answers[3], answers[1], answers[4]]
    likelihood = [matching.likelihood(answer.transformation) for answer in kept]
    assert likelihood == sorted(likelihood, reverse=True)
    assert len(likeliest(answers, matching, 9)) == len(answers)
    assert likeliest([], matching, 3) == []
