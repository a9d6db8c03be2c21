"""From many transforms to few answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from idam.consensus import FEW, FeatureMatches
from idam.pyramid import Surfaces
from idam.ranking import TOUCHING, Answer, alike, distinct, improve
from idam.refine import Refinable
from idam.scoring import agreement


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


def test_distinct_answers_stay_as_they_are() -> None:
    answers = [Answer(rigid(30 * n), 1 - n / 10) for n in range(6)]
    assert distinct(answers) == answers
    assert distinct([]) == []


# --- the score -----------------------------------------------------------------------------------------------------


def test_score_grows_with_overlap_and_with_support() -> None:
    grid = np.linspace(0, 1, 11)
    for fixed in (0.1, 0.5, 1.0):
        by_overlap = [Answer(rigid(), overlap=x, support=fixed).score for x in grid]
        by_support = [Answer(rigid(), overlap=fixed, support=x).score for x in grid]
        assert by_overlap == sorted(set(by_overlap))
        assert by_support == sorted(set(by_support))


def test_score_is_nothing_without_overlap_and_something_without_support() -> None:
    assert Answer(rigid(), overlap=0.0, support=1.0).score == 0.0
    assert Answer(rigid(), overlap=0.5, support=0.0).score > 0.0
    assert Answer(rigid()).score == 0.0


def test_few_matches_make_wrong_contact_rank_below_less_of_the_right() -> None:
    assert Answer(rigid(), overlap=0.7, support=0.0).score < Answer(rigid(), overlap=0.4, support=0.3).score
    # but matches do not make up for surfaces that lie apart
    assert Answer(rigid(), overlap=0.1, support=0.5).score < Answer(rigid(), overlap=0.7, support=0.0).score


# --- improving -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surfaces() -> Surfaces:
    """Two samplings of three unlike boxes in one pose."""
    corners = [([0, 0, 0], [1, 0.6, 0.2]), ([0, 0, 0.2], [0.2, 0.6, 0.8]), ([0.6, 0.1, 0.2], [0.9, 0.3, 0.5])]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in corners])
    clouds = [np.asarray(trimesh.sample.sample_surface(mesh, 800, seed=seed)[0]) - 0.3 for seed in (1, 2)]
    return Surfaces(*map(Refinable.build, clouds), spacing=0.03)


@pytest.fixture(scope="module")
def matches() -> FeatureMatches:
    """Two of three are right under the identity."""
    points = torch.as_tensor(np.random.default_rng(0).normal(size=(30, 3)), dtype=torch.float32)
    return FeatureMatches(points, points + torch.tensor([0.0, 0.0, 0.0, 0.0, 5.0, 5.0]).repeat(5)[:, None], 0.045)


STARTS = [rigid(170), rigid(6, 0.05), rigid(), rigid(60, 0.3)]


def test_improve_without_refinement_only_scores(surfaces: Surfaces, matches: FeatureMatches) -> None:
    found = improve([Answer(start, overlap=7.0) for start in STARTS], surfaces, matches, 4.0, "none")
    assert len(found) == len(STARTS)
    for a, start in zip(found, STARTS, strict=True):
        assert (a.transformation == start).all()
        assert a.support == matches.support(start)
        expected = agreement(surfaces.source, surfaces.target, start, TOUCHING * surfaces.spacing)
        assert a.overlap == expected.score
    assert max(found, key=lambda a: a.score) is found[2]
    assert found[2].support == pytest.approx(20 / (30 + FEW))


def test_improve_refines_each_and_scores_what_it_refined(surfaces: Surfaces, matches: FeatureMatches) -> None:
    unrefined, refined = (improve(list(map(Answer, STARTS)), surfaces, matches, 4.0, m) for m in ("none", "gicp"))
    assert len(refined) == len(STARTS)
    assert refined[1].overlap > 0.7 > 0.5 > unrefined[1].overlap
    assert refined[1].support == pytest.approx(20 / (30 + FEW))
    # the truth itself, and the one that started near it
    for a in refined[1:3]:
        assert np.degrees(Rotation.from_matrix(a.transformation[:3, :3]).magnitude()) < 1.0
        assert np.linalg.norm(a.transformation[:3, 3]) < 0.01
    assert len(distinct(refined)) == len(STARTS) - 1
    assert not alike(refined[-1].transformation, np.eye(4))


def test_refinement_reaches_only_so_far(surfaces: Surfaces, matches: FeatureMatches) -> None:
    start = Answer(rigid(6, 0.05))
    near, far = (improve([start], surfaces, matches, reach, "gicp")[0].overlap for reach in (0.3, 4.0))
    assert near < 0.6 < 0.7 < far


def test_nothing_to_improve(surfaces: Surfaces, matches: FeatureMatches) -> None:
    assert improve([], surfaces, matches, 4.0, "gicp") == []
