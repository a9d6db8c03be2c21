"""From many hypotheses to one answer: refine each, score each, let the like ones vote for one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from idam.hypotheses import Hypothesis
from idam.refine import Refinable, refine
from idam.scoring import agreement

__all__ = ["Answer", "Surfaces", "distinct", "improve"]

Points = NDArray[np.float64]

SAME_ANGLE = 10.0
"""Degrees within which two answers count as one."""
SAME_SHIFT = 0.1
"""Distance within which two answers must lay the source's centre to count as one, in working units."""
TOUCHING = 1.5
"""Spacings within which two surfaces count as touching."""


@dataclass(frozen=True)
class Surfaces:
    """Both clouds at one resolution, ready for refinement, and the spacing of their points."""

    source: Refinable
    target: Refinable
    spacing: float


@dataclass(frozen=True)
class Answer:
    """A transform (4, 4) in working coordinates, and what speaks for it.

    Attributes:
        transformation: working source to working target.
        hypothesis: where it came from.
        overlap: agreement of the clouds under it, in [0, 1].
        votes: how many hypotheses led to it.
    """

    transformation: Points
    hypothesis: Hypothesis
    overlap: float = 0.0
    votes: int = 1


def improve(answers: list[Answer], surfaces: Surfaces, reach: float, method: str) -> list[Answer]:
    """Each answer refined within ``reach`` spacings (unless the method is ``none``) and scored; the best first."""
    improved = []
    for answer in answers:
        transformation = answer.transformation
        if method != "none":
            transformation, _ = refine(
                surfaces.source, surfaces.target, transformation, reach * surfaces.spacing, method
            )
        overlap = agreement(surfaces.source, surfaces.target, transformation, TOUCHING * surfaces.spacing).score
        improved.append(replace(answer, transformation=transformation, overlap=overlap))
    return sorted(improved, key=lambda answer: -answer.overlap)


def distinct(answers: list[Answer]) -> list[Answer]:
    """The answers, best first, without those that are like a better one, which collects their votes."""
    kept: list[Answer] = []
    for answer in answers:
        for n, better in enumerate(kept):
            if alike(answer.transformation, better.transformation):
                kept[n] = replace(better, votes=better.votes + answer.votes)
                break
        else:
            kept.append(answer)
    return kept


def alike(a: Points, b: Points) -> bool:
    """Whether two working transforms (4, 4) turn and shift the source nearly the same way."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return bool(cosine > np.cos(np.radians(SAME_ANGLE)) and np.linalg.norm(a[:3, 3] - b[:3, 3]) < SAME_SHIFT)
