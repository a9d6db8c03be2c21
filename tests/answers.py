"""A result made up by hand, which several tests show, save and compare."""

from __future__ import annotations

from typing import Any

import numpy as np

from idam.result import Matches, RegistrationResult
from idam.search.judge import Evidence
from idam.search.strength import Strength

EVIDENCE = Evidence(
    likelihood=1.5,
    overlap=0.5,
    contained=0.625,
    support=0.875,
    violation=0.125,
    close=0.75,
    off=0.0625,
    border=1.0,
    fixed=0.03125,
    lead=2.25,
    geometric_lead=3.5,
)
"""Every field is another number, and few binary digits."""
STRENGTH = Strength(np.eye(6), np.linspace(0.0, 1.0, 6))


def made_up(source: np.ndarray, target: np.ndarray, transformation: np.ndarray, **fields: Any) -> RegistrationResult:
    """A result of clouds (N, 3) and (P, 3)."""
    nothing = np.empty((0, 3))
    plain = {
        "fitness": 0.75,
        "inlier_rmse": 0.0123,
        "confidence": 0.9,
        "converged": True,
        "reason": "",
        "evidence": EVIDENCE,
        "hypotheses": [],
        "max_correspondence_distance": 0.05,
        "information": np.zeros((6, 6)),
        "strength": STRENGTH,
        "scale": 1.0,
        "matches": Matches(nothing, nothing, np.empty(0)),
        "model": "gnn-unseen-shapes",
        "seconds": 0.1,
        "clouds": (source.copy(), target.copy()),
    }
    return RegistrationResult(transformation=transformation, **(plain | fields))
