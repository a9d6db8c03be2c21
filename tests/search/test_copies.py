"""Poses of symmetric things, told apart by copies of points."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import torch

import idam
from idam.clouds.pyramid import Level, spacing_of
from idam.search.matching import Matching
from idam.search.ranking import Answer
from idam.search.sparse.copies import nearer, told_apart
from matchings import anything, matching_by, vase
from motions import move, rigid


def turned(degrees: float) -> np.ndarray:
    return rigid([0.0, 0.0, np.radians(degrees)], [0.0, 0.0, 0.0])


def degrees_off(answer: Answer) -> float:
    cosine = (np.trace(answer.transformation[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def silent(source: np.ndarray, target: np.ndarray) -> Matching:
    """What features that tell nothing say of two clouds."""
    spacing = max(spacing_of(source), spacing_of(target))
    return matching_by(Level(source, target, spacing), torch.zeros(len(source), len(target)))


def copies(noise: float = 0.006) -> Matching:
    """A vase twice, point for point but for noise, its two clouds without opposite fifths."""
    points, rng = vase(800, 0), np.random.default_rng(9)
    first, second = (points + noise * rng.normal(size=points.shape) for _ in range(2))
    return silent(first[first[:, 0] < 0.3], second[second[:, 1] < 0.3])


# --- nearer --------------------------------------------------------------------------------------------------------


def test_nearer_is_a_ratio_of_likelihoods() -> None:
    rng = np.random.default_rng(0)
    near, far = rng.exponential(0.5, 300), rng.exponential(1.0, 300)

    def logarithm(squares: np.ndarray, mean: float) -> float:
        return float((-np.log(mean) - squares / mean).sum())

    assert nearer(near, far) == pytest.approx(logarithm(near, near.mean()) - logarithm(near, far.mean()))
    assert nearer(far, near) < 0
    assert nearer(near, near) < 0


def test_few_near_points_are_no_evidence_against_many() -> None:
    assert nearer(np.full(50, 0.1), np.full(300, 1.0)) < 0
    assert nearer(np.empty(0), np.ones(3)) < 0
    assert np.isfinite(nearer(np.zeros(10), np.ones(10)))
    assert np.isfinite(nearer(np.zeros(10), np.zeros(10)))


# --- told apart ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [25, 90, -130])
def test_copies_tell_how_a_vase_is_turned(degrees: float) -> None:
    found = told_apart([Answer(turned(degrees))], copies(), anything)
    assert degrees_off(found[0]) < 1.5
    assert len(found) == 1  # the wrong pose is ruled out


def test_copies_choose_among_answers() -> None:
    flipped = np.diag([1.0, -1.0, -1.0, 1.0])
    found = told_apart([Answer(flipped, likelihood=1.0), Answer(np.eye(4), likelihood=0.9)], copies(), anything)
    assert degrees_off(found[0]) < 1.5
    assert all(degrees_off(answer) < 1.5 for answer in found)


def test_scans_without_a_common_point_leave_the_answers_as_they_are() -> None:
    answers = [Answer(turned(40)), Answer(turned(-70))]
    assert told_apart(answers, silent(vase(500, 3), vase(500, 4)), anything) == answers


def test_no_pose_is_taken_that_turns_too_far() -> None:
    def none(_: Iterable[np.ndarray]) -> list[Answer]:
        return []

    answers = [Answer(turned(90))]
    assert told_apart(answers, copies(), none) == answers


def test_register_lays_a_noisy_vase_as_it_stood() -> None:
    clouds = copies()
    source, target = clouds.clouds.source, clouds.clouds.target
    motion = rigid([0.3, -0.2, 1.0], [0.2, 0.1, -0.3])
    result = idam.register(source, move(motion, target))
    assert degrees_off(Answer(np.linalg.inv(motion) @ result.transformation)) < 2.0
    # told that it turns by less than it does, it does not take the right pose, though copies speak for it
    kept = idam.register(source, move(motion, target), max_angle=30)
    assert degrees_off(Answer(kept.transformation)) < 40
