"""Why an answer may be wrong, in words."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.rigid import Array
from idam.search.judge import Evidence
from idam.search.slides import SLIPPABLE

__all__ = ["doubt"]

TIED = 1.0
"""Logits of lead below which two answers are about equally good."""
SLIGHT = 0.25
"""Overlap below which it is what is wrong."""
THROUGH = 0.005
"""Share of points where the other scan saw through from which on it is what is wrong."""
STRAIGHT = 5.0
"""Degrees between two answers below which one is the other slid; and short of 180 above which it is turned round."""


def doubt(evidence: Evidence, answer: Array, rival: Array | None, centre: Array) -> str:
    """Say why an answer may be wrong.

    Args:
        evidence: what speaks for it.
        answer: (4, 4), in input units.
        rival: the other one that it is least ahead of, (4, 4), if any.
        centre: of the source, (3,).
    """
    if rival is not None and min(evidence.lead, evidence.geometric_lead) < TIED:
        return _rival(answer, rival, centre, slides=evidence.fixed < SLIPPABLE)
    if evidence.violation > THROUGH:
        return f"{100 * evidence.violation:.1f} % of the points lie where the other scan saw through"
    if evidence.overlap < SLIGHT:
        return f"overlap about {100 * evidence.overlap:.0f} %"
    return "the surfaces that it lays on each other look little alike"


def _rival(answer: Array, other: Array, centre: Array, *, slides: bool) -> str:
    """Say in what two equally good answers (4, 4) differ, of scans that slide along each other or do not."""
    turn = float(np.degrees(rigid.angle(answer[:3, :3].T @ other[:3, :3])))
    shift = float(np.linalg.norm(rigid.apply(answer, centre[None]) - rigid.apply(other, centre[None])))
    if turn < STRAIGHT:
        if not slides:
            return f"the pattern repeats: {shift:.3g} further the scans fit about as well"
        return f"the scans slide along one direction, where their place is not fixed: {shift:.3g} further fits as well"
    if turn > 180 - STRAIGHT:
        return "the scans fit about as well the other way round"
    return f"two poses, {turn:.0f} degrees apart, explain the data about equally well"
