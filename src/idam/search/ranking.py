"""From many transforms to few answers: refine each, score each, keep one of those that are alike."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam.align import TOUCHING, align
from idam.search.matching import Matching
from idam.search.overlap import agreement
from idam.search.sparse.border import mixing

__all__ = ["Answer", "distinct", "improve", "likeliest", "scored"]

Points = NDArray[np.float64]

SAME_ANGLE = 10.0
"""Degrees within which two answers count as one."""
SAME_SHIFT = 0.1
"""Distance within which two answers must lay the source's centre to count as one, in working units."""
ITERATIONS = 12
"""Of the refinement before an answer is scored: right ones have come near by then, wrong ones may never."""
UNLIKELY = 0.05
"""Overlap counts for so much where the features do not speak for an answer: on flat ground they say nothing."""
MIXED = 2.0
"""How fast the score of sparse clouds' answers falls with :func:`idam.search.sparse.border.mixing`. The features of dense clouds say
enough, and what a scanner sees of them does not end at a plane."""


@dataclass(frozen=True)
class Answer:
    """A transform in working coordinates, and what speaks for it.

    Attributes:
        transformation: (4, 4), working source to working target.
        overlap: agreement of the clouds under it, in [0, 1].
        support: share of the feature matches that it brings together, in [0, 1].
        likelihood: how much likelier the features make it than chance (:meth:`idam.search.matching.Matching.likelihood`).
        border: 1 where what only one cloud shows lies past where the other ends, less where it lies amid the other
            (:func:`idam.search.sparse.border.mixing`), of sparse clouds.
    """

    transformation: Points
    overlap: float = 0.0
    support: float = 0.0
    likelihood: float = 0.0
    border: float = 1.0

    @property
    def score(self) -> float:
        """What answers are ranked by: surfaces slid into wrong contact overlap, too, but their points are not alike."""
        return (max(self.likelihood, 0.0) + UNLIKELY * self.overlap) * self.border


def improve(answers: list[Answer], matching: Matching, reach: float, method: str) -> list[Answer]:
    """Each answer refined on the matched clouds, within ``reach`` spacings (with method ``none`` not), and scored."""
    surfaces = matching.clouds.surfaces
    aligned = [align(surfaces, answer.transformation, reach, method, ITERATIONS)[0] for answer in answers]
    return [scored(transformation, matching, sparse=method == "symmetric") for transformation in aligned]


def scored(transformation: Points, matching: Matching, *, sparse: bool) -> Answer:
    """A transform (4, 4) with all that speaks for it on the matched clouds."""
    surfaces = matching.clouds.surfaces
    overlap = agreement(surfaces.source, surfaces.target, transformation, TOUCHING * surfaces.spacing).score
    border = math.exp(-MIXED * mixing(surfaces, transformation)) if sparse else 1.0
    support = matching.matches.support(transformation)
    return Answer(transformation, overlap, support, matching.likelihood(transformation), border)


def likeliest(answers: list[Answer], matching: Matching, most: int) -> list[Answer]:
    """The ``most`` likeliest of the answers as they are, the likeliest first.

    Next to refining an answer, to ask for its likelihood costs nothing; and to refine more of them gains nothing.
    """
    likelihood = [matching.likelihood(answer.transformation) for answer in answers]
    order = np.argsort(likelihood, kind="stable")[::-1]
    return [answers[n] for n in order[:most]]


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
