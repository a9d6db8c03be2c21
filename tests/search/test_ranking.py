"""From many transforms to few answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idam.align import align, reaches
from idam.clouds.surfaces import TOUCHING, Surface, Surfaces, spacing_of
from idam.clouds.viewpoint import FreeSpace
from idam.search.matching import FEW, FeatureMatches, Matching
from idam.search.overlap import exactness, shares
from idam.search.ranking import (
    MOST_VIOLATION,
    UNLIKELY,
    VIOLATION,
    Answer,
    distinct,
    improve,
    likeliest,
    ranked,
    same,
    scored,
    verified,
)
from matchings import level, matching_by, scores_for
from motions import degrees as angle_between
from motions import rigid as by_vector
from rooms import room
from solids import boxes

CORNERS = [([0, 0, 0], [1, 0.6, 0.2]), ([0, 0, 0.2], [0.2, 0.6, 0.8]), ([0.6, 0.1, 0.2], [0.9, 0.3, 0.5])]
"""Three unlike boxes."""


def rigid(degrees: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """A turn about some axis and a shift along some other."""
    return by_vector(np.radians(degrees) * np.array([0.6, 0.0, 0.8]), shift * np.array([0.0, 0.8, -0.6]))


# --- like answers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degrees", "shift", "alike"),
    [(0, 0, True), (9.9, 0, True), (10.1, 0, False), (180, 0, False), (0, 0.099, True), (0, 0.101, False)],
)
def test_same(degrees: float, shift: float, alike: bool) -> None:
    base = rigid(77.0, 0.4)
    # turned after the shift is undone, so that the source's centre goes to the same place
    other = base.copy()
    other[:3, :3] = rigid(degrees)[:3, :3] @ base[:3, :3]
    other[:3, 3] += rigid(shift=shift)[:3, 3]
    assert bool(same(base, other)) is bool(same(other, base)) is alike
    np.testing.assert_array_equal(same(base, np.array([other, base])), [alike, True])


def test_distinct_keeps_the_first_of_those_that_are_alike() -> None:
    transforms = np.array([rigid(0), rigid(90), rigid(5), rigid(90, 0.5), rigid(94), rigid(-6)])
    assert distinct(transforms).tolist() == [0, 1, 3]


def test_distinct_stops_at_as_many_as_asked_for() -> None:
    transforms = np.array([rigid(20 * n) for n in range(6)])
    assert distinct(transforms, 3).tolist() == [0, 1, 2]
    assert distinct(transforms, 7).tolist() == list(range(6))
    assert distinct(transforms[:0]).tolist() == []


def test_distinct_is_that_of_comparing_one_by_one() -> None:
    random = np.random.default_rng(0)
    transforms = np.array([by_vector(0.2 * random.normal(size=3), 0.1 * random.normal(size=3)) for _ in range(120)])
    kept: list[int] = []
    for n, one in enumerate(transforms):
        if not any(same(transforms[k], one) for k in kept):
            kept.append(n)
    assert 5 < len(kept) < 100
    assert distinct(transforms).tolist() == kept


def test_ranked_sorts_and_keeps_the_better_of_two_that_are_alike() -> None:
    worse, better, other = Answer(rigid(), 0.3), Answer(rigid(3), 0.6), Answer(rigid(60), 0.5)
    assert ranked(iter([worse, other, better])) == [better, other]
    assert ranked([]) == []


def test_ties_stay_in_order() -> None:
    answers = [Answer(rigid(30 * n), 0.5) for n in range(5)]
    assert ranked(answers) == answers


# --- the score -----------------------------------------------------------------------------------------------------


def test_score_grows_with_likelihood_with_overlap_and_with_the_border() -> None:
    for fixed in (0.0, 0.5, 1.0):
        by_likelihood = [Answer(rigid(), overlap=fixed, likelihood=x).score for x in np.linspace(0, 4, 11)]
        by_overlap = [Answer(rigid(), overlap=x, likelihood=4 * fixed).score for x in np.linspace(0, 1, 11)]
        by_border = [Answer(rigid(), overlap=0.5, likelihood=fixed, border=x).score for x in np.linspace(0, 1, 11)]
        for scores in (by_likelihood, by_overlap, by_border):
            assert scores == sorted(set(scores))


def test_features_that_speak_against_an_answer_count_as_saying_nothing() -> None:
    against, silent = (Answer(rigid(), overlap=0.8, likelihood=x).score for x in (-2.0, 0.0))
    assert against == silent == pytest.approx(UNLIKELY * 0.8)
    assert Answer(rigid()).score == 0.0


def test_wrong_contact_ranks_below_less_overlap_of_points_that_are_alike() -> None:
    assert Answer(rigid(), overlap=0.9, likelihood=0.02).score < Answer(rigid(), overlap=0.2, likelihood=0.2).score
    # and between answers of which the features say nothing, overlap decides
    assert Answer(rigid(), overlap=0.2, likelihood=-0.1).score < Answer(rigid(), overlap=0.4, likelihood=-0.5).score


def test_points_in_free_space_halve_a_score_and_count_up_to_a_point() -> None:
    def score(violation: float) -> float:
        return Answer(rigid(), overlap=0.5, likelihood=2.0, violation=violation).score

    assert score(VIOLATION) == pytest.approx(score(0.0) / 2)
    scores = [score(x) for x in np.linspace(0, MOST_VIOLATION, 6)]
    assert scores == sorted(set(scores), reverse=True)
    assert score(0.5) == score(MOST_VIOLATION) > 0


# --- improving -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def matching() -> Matching:
    """Two samplings of one part in one pose: two of three matches are right under the identity, and so are scores."""
    points = np.random.default_rng(0).normal(size=(30, 3))
    wrong = np.array([0.0, 0.0, 0.0, 0.0, 5.0, 5.0]).repeat(5)[:, None]
    clouds = level(boxes(CORNERS, 800, seed=1) - 0.3, boxes(CORNERS, 800, seed=2) - 0.3)
    return matching_by(clouds, scores_for(clouds, rigid()), FeatureMatches(points, points + wrong, 0.045))


STARTS = np.array([rigid(170), rigid(6, 0.05), rigid(), rigid(60, 0.3)])


def test_improve_without_refinement_only_scores(matching: Matching) -> None:
    surfaces = matching.clouds.surfaces
    found = improve(STARTS, matching, 4.0, "none")
    for answer, start in zip(found, STARTS, strict=True):
        assert (answer.transformation == start).all()
        assert answer.support == matching.matches.support(start)
        assert answer.likelihood == matching.likelihood(start)
        assert answer.overlap == pytest.approx(np.prod(shares(surfaces, start)) ** 0.5, abs=1e-12)
        assert answer.contained == max(shares(surfaces, start))
        # what nobody has looked at yet speaks against it
        assert (answer.close, answer.off, answer.violation) == (0.0, 1.0, 0.0)
        assert answer.border == 1.0
    assert max(found, key=lambda answer: answer.score) is found[2]
    assert found[2].support == pytest.approx(20 / (30 + FEW))


def test_improve_refines_each_and_scores_what_it_refined(matching: Matching) -> None:
    unrefined, refined = (improve(STARTS, matching, 4.0, method) for method in ("none", "gicp"))
    assert len(refined) == len(STARTS)
    assert refined[1].overlap > unrefined[1].overlap + 0.15
    assert refined[1].likelihood > unrefined[1].likelihood + 0.3
    # the truth itself, and the one that started near it
    for answer in refined[1:3]:
        assert angle_between(answer.transformation, np.eye(4)) < 1.5
        assert np.linalg.norm(answer.transformation[:3, 3]) < 0.02
    assert len(ranked(refined)) == len(STARTS) - 1
    assert not same(refined[-1].transformation, np.eye(4))


def test_sparse_clouds_are_asked_where_what_only_one_shows_lies(matching: Matching) -> None:
    (start,) = improve(STARTS[:1], matching, 1.0, "none")
    sparse = scored(start.transformation, matching, sparse=True)
    assert 0.0 < sparse.border < 1.0
    assert sparse.overlap == start.overlap
    assert sparse.score == pytest.approx(start.score * sparse.border)


def test_refinement_reaches_only_so_far(matching: Matching) -> None:
    near, far = (improve(STARTS[1:2], matching, reach, "gicp")[0].overlap for reach in (0.3, 4.0))
    assert near + 0.1 < far


def test_nothing_to_improve(matching: Matching) -> None:
    assert improve(STARTS[:0], matching, 4.0, "gicp") == []


def test_the_likeliest_come_first_and_no_more_than_asked_for(matching: Matching) -> None:
    transforms = np.array([rigid(degrees, 0.01 * degrees) for degrees in (40, 3, 170, 0, 1)])
    np.testing.assert_array_equal(likeliest(transforms, matching, 3), transforms[[3, 4, 1]])
    np.testing.assert_array_equal(likeliest(transforms, matching, 2), transforms[[3, 4]])
    # far from as likely as the best, and not worth a refinement
    assert len(likeliest(transforms, matching, 9)) < len(transforms)


def test_of_equally_likely_ones_the_first_comes_first(matching: Matching) -> None:
    far = np.array([rigid(10 * n, 50.0) for n in range(5)])  # nothing is said of any
    np.testing.assert_array_equal(likeliest(far, matching, 3), far[:3])


def test_those_that_lay_most_of_the_source_on_the_target_come_besides(matching: Matching) -> None:
    against = matching_by(matching.clouds, -scores_for(matching.clouds, rigid()), matching.matches)
    transforms = np.array([rigid(0, 50.0), rigid(1, 0.01), rigid(40, 0.4), rigid(0, 0.0)])
    likelihood, share = against.likelihoods(transforms)
    assert likelihood[0] == 0.0 > likelihood[3]  # what is laid on nothing is likelier than the truth
    assert np.argmax(share) == 3
    np.testing.assert_array_equal(likeliest(transforms, against, 1), transforms[[0]])
    np.testing.assert_array_equal(likeliest(transforms, against, 1, 2), transforms[[0, 3, 1]])


# --- on the fine clouds --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fine() -> Surfaces:
    """The same part, sampled more densely."""
    source, target = (boxes(CORNERS, 3000, seed) - 0.3 for seed in (3, 4))
    return Surfaces(Surface.of(source), Surface.of(target), spacing_of(source))


@pytest.mark.parametrize("method", ["none", "gicp"])
def test_verified_is_refined_on_the_fine_clouds_and_measured_there(
    matching: Matching, fine: Surfaces, method: str
) -> None:
    (answer,) = improve(np.array([rigid(2, 0.01)]), matching, 1.0, "none")
    checked = verified(answer, matching, fine, method)
    expected = align(fine, answer.transformation, reaches(method)[1], method)
    # in a few steps it comes within a thousandth of the spacing of where all of them end
    np.testing.assert_allclose(checked.transformation, expected, atol=1e-3 * fine.spacing)
    reach = TOUCHING * matching.clouds.surfaces.spacing
    assert (checked.close, checked.off) == exactness(fine, checked.transformation, reach)
    # what the matched clouds said of it stays
    for name in ("overlap", "contained", "support", "likelihood", "border"):
        assert getattr(checked, name) == getattr(answer, name)


def test_verified_tells_what_only_seems_to_touch_from_the_truth(matching: Matching, fine: Surfaces) -> None:
    right, near = (verified(Answer(pose), matching, fine, "none") for pose in (rigid(), rigid(4, 0.03)))
    assert right.close > near.close
    assert right.off < near.off
    refined = verified(Answer(rigid(4, 0.03)), matching, fine, "gicp")
    assert angle_between(refined.transformation, np.eye(4)) < 1.0
    assert refined.off < near.off


def test_answers_are_asked_what_they_lay_in_free_space() -> None:
    seen = room(3000)
    space = FreeSpace.of(Surface.of(seen), Surface.of(seen), (None, np.zeros(3)), 0.05)
    clouds = replace(level(seen, seen), free_space=space)
    matching = matching_by(clouds, np.zeros((3000, 3000)))
    wrong = by_vector([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    right, slid = improve(np.array([np.eye(4), wrong]), matching, 1.0, "none")
    assert right.violation == 0.0
    assert slid.violation == space.violation(wrong) > 0.05
    checked = verified(Answer(wrong), matching, clouds.surfaces, "none")
    assert checked.violation == slid.violation
