"""From many hypotheses to one answer."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from idam.hypotheses import Hypothesis
from idam.ranking import TOUCHING, Answer, Surfaces, alike, distinct, improve
from idam.refine import Refinable
from idam.result import Matches
from idam.scoring import agreement


def rigid(degrees: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """A turn about some axis and a shift along some other."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    matrix[:3, 3] = shift * np.array([0.0, 0.8, -0.6])
    return matrix


def answer(transformation: np.ndarray, overlap: float = 0.0, votes: int = 1) -> Answer:
    nothing = Matches(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    return Answer(transformation, Hypothesis(transformation, nothing), overlap, votes)


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


def test_distinct_gives_the_votes_of_like_answers_to_the_best() -> None:
    answers = [
        answer(rigid(0), 0.9),
        answer(rigid(90), 0.8, votes=2),
        answer(rigid(5), 0.7, votes=3),
        answer(rigid(90, 0.5), 0.6),
        answer(rigid(94), 0.5),
        answer(rigid(-6), 0.4),
    ]
    kept = distinct(answers)
    assert [a.overlap for a in kept] == [0.9, 0.8, 0.6]
    assert [a.votes for a in kept] == [1 + 3 + 1, 2 + 1, 1]
    assert all(a.hypothesis is b.hypothesis for a, b in zip(kept, (answers[0], answers[1], answers[3]), strict=True))


def test_distinct_answers_stay_as_they_are() -> None:
    answers = [answer(rigid(30 * n), 1 - n / 10) for n in range(6)]
    assert distinct(answers) == answers
    assert distinct([]) == []


# --- improving -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surfaces() -> Surfaces:
    """Two samplings of three unlike boxes in one pose."""
    corners = [([0, 0, 0], [1, 0.6, 0.2]), ([0, 0, 0.2], [0.2, 0.6, 0.8]), ([0.6, 0.1, 0.2], [0.9, 0.3, 0.5])]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in corners])
    clouds = [np.asarray(trimesh.sample.sample_surface(mesh, 800, seed=seed)[0]) - 0.3 for seed in (1, 2)]
    return Surfaces(*map(Refinable.build, clouds), spacing=0.03)


STARTS = [rigid(170), rigid(6, 0.05), rigid(), rigid(60, 0.3)]


def test_improve_without_refinement_only_scores_and_sorts(surfaces: Surfaces) -> None:
    found = improve([answer(start, votes=n) for n, start in enumerate(STARTS)], surfaces, 4.0, "none")
    assert found[0].votes == 2
    overlaps = [a.overlap for a in found]
    assert overlaps == sorted(overlaps, reverse=True)
    for a in found:
        assert (a.transformation == STARTS[a.votes]).all()
        expected = agreement(surfaces.source, surfaces.target, a.transformation, TOUCHING * surfaces.spacing)
        assert a.overlap == expected.score


def test_improve_refines_each(surfaces: Surfaces) -> None:
    unrefined = improve(list(map(answer, STARTS)), surfaces, 4.0, "none")
    refined = improve(list(map(answer, STARTS)), surfaces, 4.0, "gicp")
    assert len(refined) == len(STARTS)
    assert refined[1].overlap > 0.7 > 0.5 > unrefined[1].overlap
    # the truth itself, and the one that started near it
    for a in refined[:2]:
        assert np.degrees(Rotation.from_matrix(a.transformation[:3, :3]).magnitude()) < 1.0
        assert np.linalg.norm(a.transformation[:3, 3]) < 0.01
    assert distinct(refined)[0].votes == 2
    assert not alike(refined[-1].transformation, np.eye(4))


def test_refinement_reaches_only_so_far(surfaces: Surfaces) -> None:
    start = answer(rigid(6, 0.05))
    near, far = (improve([start], surfaces, reach, "gicp")[0].overlap for reach in (0.3, 4.0))
    assert near < 0.6 < 0.7 < far


def test_ties_stay_in_order(surfaces: Surfaces) -> None:
    found = improve([answer(rigid(), votes=n) for n in range(4)], surfaces, 4.0, "none")
    assert [a.votes for a in found] == [0, 1, 2, 3]
