"""From many transforms to few answers: refine each, score each, keep one of those that are alike."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam.consensus import FeatureMatches
from idam.pyramid import Surfaces
from idam.refine import refine
from idam.scoring import agreement

__all__ = ["Answer", "distinct", "improve"]

Points = NDArray[np.float64]

SAME_ANGLE = 10.0
"""Degrees within which two answers count as one."""
SAME_SHIFT = 0.1
"""Distance within which two answers must lay the source's centre to count as one, in working units."""
TOUCHING = 1.5
"""Spacings within which two surfaces count as touching."""


ITERATIONS = 12
"""Of the refinement before an answer is scored: right ones have come near by then, wrong ones may never."""
CHANCE = 0.01
"""Share of the feature matches that a wrong answer brings together by chance."""


@dataclass(frozen=True)
class Answer:
    """A transform in working coordinates, and what speaks for it.

    Attributes:
        transformation: (4, 4), working source to working target.
        overlap: agreement of the clouds under it, in [0, 1].
        support: share of the feature matches that it brings together, in [0, 1].
    """

    transformation: Points
    overlap: float = 0.0
    support: float = 0.0

    @property
    def score(self) -> float:
        """What answers are ranked by: surfaces slid into wrong contact overlap, too, but few matches come along."""
        return float(self.overlap * (self.support + CHANCE) ** 0.25)


def improve(
    answers: list[Answer], surfaces: Surfaces, matches: FeatureMatches, reach: float, method: str
) -> list[Answer]:
    """Each answer refined within ``reach`` spacings (unless the method is ``none``) and scored."""
    improved = []
    for answer in answers:
        transformation = answer.transformation
        if method != "none":
            transformation, _ = refine(
                surfaces.source, surfaces.target, transformation, reach * surfaces.spacing, method, ITERATIONS
            )
        overlap = agreement(surfaces.source, surfaces.target, transformation, TOUCHING * surfaces.spacing).score
        improved.append(Answer(transformation, overlap, matches.support(transformation)))
    return improved


def distinct(answers: Iterable[Answer], most: int | None = None) -> list[Answer]:
    """The answers without those that are like an earlier one, the first ``most`` of them."""
    kept: list[Answer] = []
    for answer in answers:
        if len(kept) == most:
            break
        if not any(alike(answer.transformation, other.transformation) for other in kept):
            kept.append(answer)
    return kept


def alike(a: Points, b: Points) -> bool:
    """Whether two working transforms (4, 4) turn and shift the source nearly the same way."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return bool(cosine > np.cos(np.radians(SAME_ANGLE)) and np.linalg.norm(a[:3, 3] - b[:3, 3]) < SAME_SHIFT)
