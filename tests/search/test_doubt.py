"""Why an answer may be wrong, in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from answers import EVIDENCE
from idam.search.doubt import SLIGHT, STRAIGHT, THROUGH, TIED, doubt
from idam.search.judge import Evidence
from idam.search.slides import SLIPPABLE
from motions import rigid

CENTRE = np.array([3.0, -1.0, 0.5])
POSE = rigid([0.4, -1.0, 0.3], [10.0, 0.0, -2.0])
ALIKE = "the surfaces that it lays on each other look little alike"
AHEAD = replace(EVIDENCE, violation=0.0, fixed=0.5 * SLIPPABLE, lead=1.5 * TIED, geometric_lead=1.5 * TIED)
"""Ahead of the next answer, of good overlap, with no point in free space; it may slide."""


def about_the_centre(angle: float, shift: float) -> np.ndarray:
    """The pose with the source turned about its centre by so many degrees, and shifted."""
    turn = rigid(np.radians(angle) * np.array([0.0, 0.6, 0.8]), [0.0, 0.0, 0.0])
    there, back = rigid([0, 0, 0], CENTRE), rigid([0, 0, 0], -CENTRE)
    return rigid([0, 0, 0], shift * np.array([0.6, 0.0, -0.8])) @ POSE @ there @ turn @ back


def said(evidence: Evidence, rival: np.ndarray | None = None) -> str:
    return doubt(evidence, POSE, rival, CENTRE)


@pytest.mark.parametrize(
    ("evidence", "reason"),
    [
        (replace(AHEAD, violation=3 * THROUGH), "1.5 % of the points lie where the other scan saw through"),
        (replace(AHEAD, overlap=0.9 * SLIGHT), "overlap about 22 %"),
        (AHEAD, ALIKE),
        (replace(AHEAD, violation=THROUGH, overlap=SLIGHT), ALIKE),
    ],
)
def test_of_an_answer_that_is_ahead_it_names_what_speaks_against_it(evidence: Evidence, reason: str) -> None:
    assert said(evidence, about_the_centre(90, 0.0)) == reason
    assert said(replace(evidence, lead=0.0)) == reason  # of an only answer, too


@pytest.mark.parametrize(
    ("angle", "shift", "reason"),
    [
        (0.0, 2.5, "the scans slide along one direction, where their place is not fixed: 2.5 further fits as well"),
        (
            0.8 * STRAIGHT,
            0.125,
            "the scans slide along one direction, where their place is not fixed: 0.125 further fits as well",
        ),
        (180.0, 0.0, "the scans fit about as well the other way round"),
        (180.0 - 0.8 * STRAIGHT, 1.0, "the scans fit about as well the other way round"),
        (90.0, 0.0, "two poses, 90 degrees apart, explain the data about equally well"),
        (1.2 * STRAIGHT, 0.0, "two poses, 6 degrees apart, explain the data about equally well"),
    ],
)
def test_of_two_answers_that_are_tied_it_says_in_what_they_differ(angle: float, shift: float, reason: str) -> None:
    tied = replace(AHEAD, lead=0.9 * TIED)
    assert said(tied, about_the_centre(angle, shift)) == reason
    # behind, even: first because it turns least
    assert said(replace(tied, lead=-1.0), about_the_centre(angle, shift)) == reason
    # or only as far as the surfaces tell
    assert said(replace(AHEAD, geometric_lead=0.9 * TIED), about_the_centre(angle, shift)) == reason


def test_what_does_not_slide_repeats() -> None:
    tied = replace(AHEAD, lead=0.0)
    along = about_the_centre(0.0, 2.5)
    assert "slide" in said(replace(tied, fixed=0.9 * SLIPPABLE), along)
    reason = said(replace(tied, fixed=SLIPPABLE), along)
    assert reason == "the pattern repeats: 2.5 further the scans fit about as well"


def test_two_poses_are_named_before_free_space_and_free_space_before_little_overlap() -> None:
    worst = replace(EVIDENCE, lead=0.0, violation=0.02, overlap=0.0)
    assert "two poses" in said(worst, about_the_centre(90, 0.0))
    assert "saw through" in said(replace(worst, lead=TIED), about_the_centre(90, 0.0))
    assert said(replace(worst, lead=TIED, violation=0.0)) == "overlap about 0 %"


def test_doubt_goes_into_a_sentence() -> None:
    random = np.random.default_rng(0)
    for a, b, c, angle in random.uniform(0, 1, (40, 4)).tolist():
        evidence = replace(EVIDENCE, lead=2 * a, violation=0.01 * b, overlap=0.5 * c)
        reason = said(evidence, about_the_centre(180 * angle, a))
        assert not reason[0].isupper()
        assert not reason.endswith(".")
        assert "\n" not in reason
