"""How sure a registration is, and why it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from idam.search.confidence import CLOSE, LITTLE, SLIGHT, Evidence, confidence, doubt, features

CLEAR = Evidence(overlap=0.95, support=0.7, likelihood=3.0, margin=0.9)
"""A clean pair with much overlap."""
NOTHING = Evidence(overlap=0.0, support=0.0, likelihood=0.0, margin=0.0)
GRID = [float(x) for x in np.linspace(0, 1, 6)]


def any_evidence(count: int, most: float = 1.0) -> list[Evidence]:
    shares = np.random.default_rng(0).uniform(0, most, size=(count, 4)).tolist()
    return [Evidence(overlap, support, 6 * said - 2, margin) for overlap, support, said, margin in shares]


def test_confidence_is_a_probability() -> None:
    for evidence in any_evidence(50):
        assert 0.0 < confidence(evidence) < 1.0


@pytest.mark.parametrize("name", ["overlap", "support", "likelihood", "margin"])
@pytest.mark.parametrize("base", [CLEAR, NOTHING])
def test_confidence_does_not_fall_as_the_evidence_grows(name: str, base: Evidence) -> None:
    grown = [confidence(replace(base, **{name: x})) for x in GRID]
    assert grown == sorted(grown)


def test_confident_of_a_clean_pair_and_not_of_nothing() -> None:
    assert confidence(CLEAR) > 0.9
    assert confidence(NOTHING) < 0.5


@pytest.mark.parametrize("margin", [0.0, 0.5, 1.0])
def test_not_confident_where_clouds_barely_touch_and_no_match_agrees(margin: float) -> None:
    assert confidence(Evidence(overlap=0.05, support=0.0, likelihood=0.0, margin=margin)) < 0.5


@pytest.mark.parametrize("name", ["overlap", "likelihood"])
@pytest.mark.parametrize("extreme", [-1e300, 1e300])
def test_absurd_evidence_does_not_overflow(name: str, extreme: float) -> None:
    assert 0.0 <= confidence(replace(CLEAR, **{name: extreme})) <= 1.0


def test_the_first_that_features_say_for_an_answer_counts_for_more_than_the_last() -> None:
    said = [sum(features(replace(CLEAR, likelihood=x))) for x in GRID]
    assert (np.diff(said) > 0).all()
    assert (np.diff(said, 2) < 0).all()


def test_a_likelihood_below_chance_counts_as_none() -> None:
    assert features(replace(CLEAR, likelihood=-2.0)) == features(replace(CLEAR, likelihood=0.0))


def test_a_margin_over_answers_that_explain_still_less_says_little() -> None:
    for overlap in (0.0, 0.2, 0.5):
        evidence = replace(CLEAR, overlap=overlap, margin=LITTLE * overlap)
        assert features(replace(evidence, margin=0.9)) == features(evidence)
        assert features(replace(evidence, margin=0.9 * LITTLE * overlap)) != features(evidence) or not overlap


# --- doubt ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("evidence", "reason"),
    [
        (replace(CLEAR, margin=0.9 * CLOSE), "two poses explain the data equally well"),
        (replace(CLEAR, overlap=0.9 * SLIGHT), "overlap about 22 %"),
        (replace(CLEAR, likelihood=0.0), "the surfaces that it lays together are little alike"),
        (replace(CLEAR, margin=CLOSE, overlap=SLIGHT), "the surfaces that it lays together are little alike"),
    ],
)
def test_doubt_names_what_is_wrong(evidence: Evidence, reason: str) -> None:
    assert doubt(evidence) == reason


def test_two_poses_are_named_before_little_overlap() -> None:
    assert "two poses" in doubt(NOTHING)
    assert doubt(replace(NOTHING, margin=1.0)) == "overlap about 0 %"


def test_doubt_goes_into_a_sentence() -> None:
    for evidence in any_evidence(20, most=0.5):
        reason = doubt(evidence)
        assert reason[0].islower()
        assert not reason.endswith(".")
        assert "\n" not in reason
