"""How sure a registration is: a calibrated probability from what the answer looks like."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

__all__ = ["CONVERGED", "Evidence", "confidence", "doubt", "features"]

CONVERGED = 0.5
"""Confidence from which an answer is one to count on."""
CLOSE = 0.1
"""Margin below which two answers are equally good."""
SLIGHT = 0.25
"""Overlap below which it is what is wrong."""
LITTLE = 1.5
"""Multiple of the overlap past which a margin says no more."""


@dataclass(frozen=True)
class Evidence:
    """What the confidence is computed from.

    Attributes:
        overlap: agreement of the clouds under the answer, in [0, 1] (:class:`idam.search.overlap.Agreement`).
        support: share of the feature matches that the answer brings together, in [0, 1].
        likelihood: how much likelier the features make the answer than chance
            (:meth:`idam.search.matching.Matching.likelihood`).
        margin: by how much less the best other answer scores (:attr:`idam.search.ranking.Answer.score`), as a share.
    """

    overlap: float
    support: float
    likelihood: float
    margin: float


def features(evidence: Evidence) -> tuple[float, float, float]:
    """What the logistic function is linear in.

    The first bit of likelihood says more than the last; and an answer that explains little is not made sure by others
    that explain still less.
    """
    return evidence.overlap, math.sqrt(max(0.0, evidence.likelihood)), min(evidence.margin, LITTLE * evidence.overlap)


def confidence(evidence: Evidence) -> float:
    """The probability that the transform is right: a logistic function fitted to held-back synthetic pairs."""
    bias, *weights = _coefficients()
    logit = bias + sum(w * x for w, x in zip(weights, features(evidence), strict=True))
    return 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, logit))))


def doubt(evidence: Evidence) -> str:
    """Why an answer may be wrong, in words."""
    if evidence.margin < CLOSE:
        return "two poses explain the data equally well"
    if evidence.overlap < SLIGHT:
        return f"overlap about {100 * evidence.overlap:.0f} %"
    return "the surfaces that it lays together are little alike"


@lru_cache(1)
def _coefficients() -> list[float]:
    coefficients: list[float] = json.loads((resources.files("idam.search") / "confidence.json").read_text())[
        "coefficients"
    ]
    return coefficients
