"""The judge: which of the answers is likeliest to be right, and how likely that is.

Logistic functions, fitted to registrations of synthetic pairs that the models never saw (``benchmarks/fit_judge.py``).
The first weighs what speaks for an answer and ranks answers; the second does so by the surfaces alone, whatever the
features say of them: those know a scanner's pattern, and where a scene repeats they are sure of the wrong place. The
last turns what speaks for the best answer, and how far it is ahead of the next by either, into a probability.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np

from idam.rigid import Array
from idam.search.ranking import MOST_VIOLATION, VIOLATION, Answer
from idam.search.slides import SLIPPABLE

__all__ = [
    "CONVERGED",
    "FEATURES",
    "GEOMETRIC",
    "LEAD",
    "LEADS",
    "Evidence",
    "confidence",
    "evidence",
    "features",
    "geometric_weight",
    "leads",
    "rival",
    "weight",
]

CONVERGED = 0.5
"""Confidence from which an answer is one to count on."""
LEAD = 6.0
"""Logits past which being further ahead says no more: of 840 pairs, each family left out, 353, 344, 333 and 331 answers
are sure with 4, 5, 6 and 8, and 11, 9, 5 and 5 of them wrong."""
FIRST = 1.5
"""Logits of the lead that say more than the rest: with them apart, 285 of 840 pairs are sure and 10 of them wrong, each
half judged by the other, and the negative log likelihood is 0.331; without, 301, 13 and 0.343. With 1 or 2 the same."""
FEATURES = ("likelihood", "overlap", "contained", "support", "violation", "close", "off", "border", "fixed")
"""What is known of an answer (:class:`idam.search.ranking.Answer`)."""
GEOMETRIC = ("overlap", "contained", "violation", "close", "off", "border")
"""What the surfaces alone say of it."""
LEADS = ("lead", "geometric_lead", "first_lead")
"""What the confidence is computed from besides: both leads (:class:`Evidence`), and the first logits of the lead."""


@dataclass(frozen=True)
class Evidence:
    """What the confidence is computed from.

    Attributes:
        likelihood: how much likelier the features make the answer than chance
            (:meth:`idam.search.matching.Matching.likelihood`).
        overlap: geometric mean of the shares of both clouds that lie on the other, in [0, 1].
        contained: the larger of both shares, in [0, 1].
        support: share of the feature matches that the answer brings together, in [0, 1].
        violation: share of the points that lie where the other scan saw through, in [0, 1].
        close: share of what touches that touches at a finer resolution, too, in [0, 1].
        off: median distance from the other cloud's tangent planes, as a share of the reach within which clouds touch.
        fixed: least share of a motion that goes along the normals of what touches, in [0, 1].
        border: 1 where sparse clouds end where the other begins, less where they are mixed, in [0, 1].
        lead: by how many logits the answer is ahead of the best other one.
        geometric_lead: likewise, as far as the surfaces alone tell.
    """

    likelihood: float
    overlap: float
    contained: float
    support: float
    violation: float
    close: float
    off: float
    border: float
    fixed: float
    lead: float
    geometric_lead: float


class _Fit(NamedTuple):
    weights: Array
    geometry: Array
    bias: float
    known: Array
    leads: Array


def features(answer: Answer | Evidence) -> Array:
    """What the first function is linear in, (9,): the first bit of likelihood or violation says more than the last."""
    return np.array(
        [
            math.sqrt(max(answer.likelihood, 0.0)),
            answer.overlap,
            answer.contained,
            answer.support,
            -math.log1p(min(answer.violation, MOST_VIOLATION) / VIOLATION),
            answer.close,
            -math.log(answer.off + 0.01),
            math.log(answer.border),
            math.log1p(min(answer.fixed, SLIPPABLE) / 0.001),
        ]
    )


def weight(answer: Answer | Evidence) -> float:
    """What answers are ranked by: the logit that one of several is the right one, but for a constant."""
    return float(_fit().weights @ features(answer))


def geometric_weight(answer: Answer | Evidence) -> float:
    """The same as far as the surfaces alone tell."""
    return float(_fit().geometry @ features(answer))


def evidence(answers: list[Answer]) -> Evidence:
    """What speaks for the first of the answers."""
    best, *others = answers
    others = [*others, Answer(np.eye(4))]  # an only answer has to be better than one that lays nothing on anything
    known = {name: getattr(best, name) for name in FEATURES}
    lead, geometric_lead = (
        min(by(best) - max(by(other) for other in others), LEAD) for by in (weight, geometric_weight)
    )
    return Evidence(**known, lead=lead, geometric_lead=geometric_lead)


def leads(lead: float, geometric_lead: float) -> Array:
    """What the confidence is linear in besides the features, :data:`LEADS`, (3,): a lead counts up to a point."""
    return np.clip([lead, geometric_lead, min(lead, FIRST)], -LEAD, LEAD)


def rival(answers: list[Answer]) -> int | None:
    """Which other answer the first is least ahead of, by either weight; None of an only answer."""
    first, *others = ((weight(answer), geometric_weight(answer)) for answer in answers)
    least = [min(mine - theirs for mine, theirs in zip(first, other, strict=True)) for other in others]
    return 1 + least.index(min(least)) if least else None


def confidence(known: Evidence) -> float:
    """The probability that the transform is right."""
    fit = _fit()
    logit = fit.bias + float(fit.known @ features(known)) + float(fit.leads @ leads(known.lead, known.geometric_lead))
    return 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, logit))))


@lru_cache(1)
def _fit() -> _Fit:
    held = json.loads((resources.files("idam.search") / "judge.json").read_text())
    weights, geometry, known = (
        np.array([held[part][name] for name in FEATURES]) for part in ("weights", "geometry", "confidence")
    )
    return _Fit(weights, geometry, held["bias"], known, np.array([held["leads"][name] for name in LEADS]))
