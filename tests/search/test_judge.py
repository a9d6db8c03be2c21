"""Which answer is likeliest to be right, and how likely that is."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from idam.search.judge import (
    FEATURES,
    GEOMETRIC,
    LEAD,
    Evidence,
    confidence,
    evidence,
    features,
    geometric_weight,
    leads,
    rival,
    weight,
)
from idam.search.ranking import Answer
from motions import rigid

CLEAR = Evidence(
    likelihood=3.0,
    overlap=0.95,
    contained=1.0,
    support=0.7,
    violation=0.0,
    close=1.0,
    off=0.01,
    border=1.0,
    fixed=0.2,
    lead=LEAD,
    geometric_lead=LEAD,
)
"""A clean pair with much overlap."""
NOTHING = Evidence(
    likelihood=0.0,
    overlap=0.0,
    contained=0.0,
    support=0.0,
    violation=0.05,
    close=0.0,
    off=1.0,
    border=0.2,
    fixed=0.0,
    lead=0.0,
    geometric_lead=0.0,
)
BETTER = {
    "likelihood": (-1.0, 0.0, 0.5, 1.0, 4.0),
    "overlap": (0.0, 0.3, 0.6, 1.0),
    "contained": (0.0, 0.3, 0.6, 1.0),
    "support": (0.0, 0.3, 0.6, 1.0),
    "violation": (1.0, 0.05, 0.01, 0.001, 0.0),
    "close": (0.0, 0.3, 0.6, 1.0),
    "off": (1.0, 0.5, 0.1, 0.0),
    "border": (0.05, 0.3, 0.6, 1.0),
    "fixed": (0.0, 0.001, 0.005, 0.02, 0.3),
}
"""Values of each feature, from what speaks against an answer to what speaks for it."""
GIVEN = [CLEAR, NOTHING]
BY = {"lead", "geometric_lead"}


def any_evidence(count: int) -> list[Evidence]:
    random = np.random.default_rng(0)
    shares = random.uniform(0.001, 1, (count, 6)).tolist()
    return [
        Evidence(6 * a - 2, b, max(b, c), d, e * b, f, 1 - a, c, 0.1 * d, *leads)
        for (a, b, c, d, e, f), leads in zip(shares, random.uniform(-LEAD, LEAD, (count, 2)).tolist(), strict=True)
    ]


def answer(known: Evidence, place: float = 0.0) -> Answer:
    """The answer that such evidence is of."""
    held = {name: value for name, value in asdict(known).items() if name not in BY}
    return Answer(rigid([0, 0, 0], [place, 0, 0]), **held)


# --- the weight ----------------------------------------------------------------------------------------------------


def test_every_feature_is_named_once() -> None:
    assert set(BETTER) == set(FEATURES) == set(asdict(CLEAR)) - BY
    assert features(CLEAR).shape == (len(FEATURES),)


@pytest.mark.parametrize("known", GIVEN, ids=["clear", "nothing"])
@pytest.mark.parametrize("name", FEATURES)
def test_a_feature_grows_alone_with_what_speaks_for_the_answer(name: str, known: Evidence) -> None:
    rows = np.array([features(replace(known, **{name: x})) for x in BETTER[name]])
    assert np.isfinite(rows).all()
    column = FEATURES.index(name)
    assert (np.diff(rows[:, column]) >= 0).all()
    assert rows[0, column] < rows[-1, column]
    np.testing.assert_array_equal(np.delete(rows, column, 1), np.delete(rows[:1].repeat(len(rows), 0), column, 1))


@pytest.mark.parametrize("known", GIVEN, ids=["clear", "nothing"])
@pytest.mark.parametrize("name", FEATURES)
def test_weight_and_confidence_do_not_fall_as_a_feature_grows(name: str, known: Evidence) -> None:
    grown = [replace(known, **{name: x}) for x in BETTER[name]]
    assert (np.diff([weight(each) for each in grown]) >= 0).all()
    assert (np.diff([confidence(each) for each in grown]) >= 0).all()


def test_weight_is_linear_in_the_features() -> None:
    given = any_evidence(50)
    rows = np.array([features(each) for each in given])
    weights = np.array([weight(each) for each in given])
    fitted = np.linalg.lstsq(np.c_[rows, np.ones(len(rows))], weights, rcond=None)[0]
    np.testing.assert_allclose(rows @ fitted[:-1] + fitted[-1], weights, atol=1e-8)
    assert (fitted[:-1] >= -1e-9).all()
    assert (fitted[:-1] > 1e-9).sum() >= 3  # and it is not one of them alone that decides


def test_the_first_of_what_speaks_for_or_against_an_answer_counts_for_more_than_the_last() -> None:
    def of(name: str, values: list[float]) -> np.ndarray:
        return np.diff([features(replace(CLEAR, **{name: x}))[FEATURES.index(name)] for x in values])

    likelihood = of("likelihood", [0.0, 1.0, 2.0, 3.0])
    assert (np.diff(likelihood) < 0).all()
    for name in ("violation", "off"):
        steps = of(name, [0.0, 0.01, 0.02, 0.03])
        assert (steps < 0).all()
        assert (np.diff(steps) > 0).all()


def test_past_what_a_right_answer_may_show_more_violation_says_no_more() -> None:
    assert weight(replace(CLEAR, violation=0.3)) == weight(replace(CLEAR, violation=0.9))


def test_a_likelihood_below_chance_counts_as_none() -> None:
    assert weight(replace(CLEAR, likelihood=-2.0)) == weight(replace(CLEAR, likelihood=0.0))


def test_an_answer_weighs_what_its_evidence_does() -> None:
    for known in any_evidence(20):
        assert weight(answer(known)) == weight(known)


def test_by_the_surfaces_alone_it_does_not_matter_what_the_features_say() -> None:
    for known in any_evidence(20):
        said = replace(known, likelihood=0.3, support=0.2, fixed=0.01)
        assert geometric_weight(said) == geometric_weight(known) == geometric_weight(answer(known))
        for name in GEOMETRIC:
            by_value = [geometric_weight(replace(known, **{name: x})) for x in BETTER[name]]
            assert by_value == sorted(by_value)


# --- the evidence --------------------------------------------------------------------------------------------------


def test_evidence_is_that_of_the_first_answer() -> None:
    for known in any_evidence(10):
        held = asdict(evidence([answer(known), answer(CLEAR)]))
        assert {**held, "lead": 0, "geometric_lead": 0} == {**asdict(known), "lead": 0, "geometric_lead": 0}


def test_lead_is_over_the_best_other_whatever_its_place() -> None:
    first = answer(replace(CLEAR, support=0.6))
    second, third = answer(replace(CLEAR, support=0.5)), answer(replace(CLEAR, support=0.4))
    lead = evidence([first, second, third]).lead
    assert lead == evidence([first, third, second]).lead == pytest.approx(weight(first) - weight(second))
    assert 0 < lead < evidence([first, third]).lead
    # first because it turns least, though another is a little likelier
    assert evidence([second, first]).lead == pytest.approx(-lead)
    assert evidence([first, first]).lead == 0.0


def test_the_lead_of_the_only_answer_is_the_most_that_one_has() -> None:
    for other in ([], [answer(replace(NOTHING, off=1.0, border=1e-9))]):
        known = evidence([answer(CLEAR), *other])
        assert known.lead == known.geometric_lead == LEAD


def test_the_geometric_lead_is_over_the_answer_that_the_surfaces_speak_for_most() -> None:
    first = answer(replace(CLEAR, overlap=0.9))
    unlike = answer(replace(CLEAR, likelihood=0.0, support=0.0))
    known = evidence([first, answer(replace(CLEAR, overlap=0.1)), unlike])
    assert known.geometric_lead == pytest.approx(geometric_weight(first) - geometric_weight(unlike))
    assert known.geometric_lead < 0 < known.lead


def test_the_rival_is_whom_the_first_is_least_ahead_of_by_either() -> None:
    first, poor = answer(CLEAR), answer(NOTHING)
    like, fits = answer(replace(CLEAR, overlap=0.2)), answer(replace(CLEAR, likelihood=0.0, support=0.0))
    assert rival([first]) is None
    assert rival([first, poor]) == 1
    assert rival([first, poor, fits, like]) == 2
    assert rival([first, like, poor]) == 1


def test_an_only_answer_is_ahead_of_one_that_lays_nothing_on_anything() -> None:
    nothing = Answer(rigid([0, 0, 0], [9, 0, 0]))
    assert evidence([nothing]).lead == evidence([nothing]).geometric_lead == 0.0
    little = replace(nothing, likelihood=0.01, overlap=0.05)
    assert evidence([little]).lead == pytest.approx(weight(little) - weight(nothing))
    for answers in ([nothing], [little], [little, answer(NOTHING)], [answer(NOTHING)]):
        assert confidence(evidence(answers)) < 0.5


# --- the confidence ------------------------------------------------------------------------------------------------


def test_confidence_is_a_probability() -> None:
    for known in (*any_evidence(50), *GIVEN):
        assert 0.0 < confidence(known) < 1.0


def test_confidence_grows_with_the_lead() -> None:
    for known in (*any_evidence(50), *GIVEN):
        for name in BY:
            by_lead = [confidence(replace(known, **{name: lead})) for lead in (-LEAD, -1.0, 0.0, 0.5, 2.0, LEAD)]
            assert by_lead == sorted(set(by_lead))


def test_confidence_is_a_logit_of_the_features_and_the_lead() -> None:
    given = any_evidence(60)
    inputs = np.array([[*features(each), *leads(each.lead, each.geometric_lead), 1.0] for each in given])
    logits = np.array([math.log(confidence(each) / (1 - confidence(each))) for each in given])
    fitted = np.linalg.lstsq(inputs, logits, rcond=None)[0]
    np.testing.assert_allclose(inputs @ fitted, logits, atol=1e-6)
    assert (fitted[:-1] >= -1e-9).all()


def test_the_first_logits_of_the_lead_say_more_than_the_last() -> None:
    def logit(known: Evidence) -> float:
        return math.log(confidence(known) / (1 - confidence(known)))

    steps = np.diff([logit(replace(NOTHING, lead=lead)) for lead in (-2.0, 0.0, 2.0, 4.0)])
    assert steps[0] > steps[2] > 0


def test_how_far_behind_it_is_counts_up_to_a_point() -> None:
    for name in BY:
        assert confidence(replace(CLEAR, **{name: -50.0})) == confidence(replace(CLEAR, **{name: -LEAD}))


def test_confident_of_a_clean_pair_and_not_of_nothing() -> None:
    assert confidence(CLEAR) > 0.9
    assert confidence(NOTHING) < 0.5
    nothing = Answer(np.eye(4))
    assert confidence(evidence([nothing])) < 0.1


@pytest.mark.parametrize(
    ("name", "value"), [("likelihood", 1e300), ("likelihood", -1e300), ("lead", -1e300), ("geometric_lead", -1e300)]
)
def test_absurd_evidence_does_not_overflow(name: str, value: float) -> None:
    assert 0.0 <= confidence(replace(CLEAR, **{name: value})) <= 1.0
    assert math.isfinite(weight(replace(CLEAR, **{name: value})))
