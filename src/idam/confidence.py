"""How sure a registration is: a calibrated probability from what the answer looks like."""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass
from functools import lru_cache
from importlib import resources

__all__ = ["Evidence", "confidence"]


@dataclass(frozen=True)
class Evidence:
    """What the confidence is computed from.

    Attributes:
        overlap: agreement of the clouds under the answer, in [0, 1] (:class:`idam.scoring.Agreement`).
        margin: by how much that exceeds the agreement under the best other answer, in [0, 1].
        support: share of the network's weight whose matches the answer brings together.
        votes: share of the starts that led to the answer.
    """

    overlap: float
    margin: float
    support: float
    votes: float


def confidence(evidence: Evidence) -> float:
    """The probability that the transform is right: a logistic function fitted to held-back synthetic pairs."""
    bias, *weights = _coefficients()
    logit = bias + sum(w * x for w, x in zip(weights, astuple(evidence), strict=True))
    return 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, logit))))


@lru_cache(1)
def _coefficients() -> list[float]:
    coefficients: list[float] = json.loads((resources.files("idam") / "confidence.json").read_text())["coefficients"]
    return coefficients
