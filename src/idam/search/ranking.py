"""From many transforms to few answers: refine each, score each, keep one of those that are alike."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from idam.align import align, reaches
from idam.clouds.surfaces import TOUCHING, Surfaces
from idam.rigid import Array
from idam.search.matching import Matching
from idam.search.overlap import exactness, shares
from idam.search.slides import slippage
from idam.search.sparse.border import mixing

__all__ = ["Answer", "distinct", "improve", "likeliest", "ranked", "same", "scored", "verified"]

SAME_ANGLE = 10.0
"""Degrees within which two answers count as one."""
SAME_SHIFT = 0.1
"""Distance within which two answers must lay the source's centre to count as one, in working units."""
ITERATIONS = 12
"""Of the refinement before an answer is scored: right ones have come near by then, wrong ones may never."""
STEPS = 4
"""Of the refinement on the fine clouds, where an answer comes from the coarser ones; the last one has more."""
UNLIKELY = 0.05
"""Overlap counts for so much where the features do not speak for an answer: on flat ground they say nothing."""
VIOLATION, MOST_VIOLATION = 0.01, 0.1
"""Share of points where the other scan saw through that halves a score; and the most that counts, since scans of
moving objects and bleeding edges have some in the right pose."""
PROMISING, SLIGHT = 0.3, 0.02
"""Share of the greatest likelihood from which on a transform is refined; and what makes no difference, about as much as
the overlap of answers that nothing speaks for."""
MIXED = 2.0
"""How fast the score of sparse clouds' answers falls with :func:`idam.search.sparse.border.mixing`. The features of
dense clouds say enough, and what a scanner sees of them does not end at a plane."""


@dataclass(frozen=True, eq=False)
class Answer:
    """A transform in working coordinates, and what speaks for it.

    Attributes:
        transformation: (4, 4), working source to working target.
        overlap: geometric mean of the shares of both clouds that lie on the other, in [0, 1].
        contained: the larger of both shares, in [0, 1]: 1 for a part in a whole.
        support: share of the feature matches that it brings together, in [0, 1].
        likelihood: how much likelier the features make it than chance
            (:meth:`idam.search.matching.Matching.likelihood`).
        border: 1 where what only one cloud shows lies past where the other ends, less where it lies amid the other
            (:func:`idam.search.sparse.border.mixing`), of sparse clouds.
        violation: share of the points that lie where the other scan saw through, in [0, 1].
        close: share of what touches that touches on the fine clouds, too, in [0, 1]
            (:func:`idam.search.overlap.exactness`); of answers that were refined on them.
        off: median distance from the tangent planes there, as a share of the reach.
        fixed: share of a motion that goes along the normals of what touches, of the motion that it is least of, in
            [0, 1] (:func:`idam.search.slides.slippage`): 0 for what slides freely.
    """

    transformation: Array
    overlap: float = 0.0
    contained: float = 0.0
    support: float = 0.0
    likelihood: float = 0.0
    border: float = 1.0
    violation: float = 0.0
    close: float = 0.0
    off: float = 1.0
    fixed: float = 0.0

    @property
    def score(self) -> float:
        """What answers are ranked by before they are refined on the fine clouds.

        Surfaces slid into wrong contact overlap, too, but their points are not alike.
        """
        explained = max(self.likelihood, 0.0) + UNLIKELY * self.overlap
        return explained * self.border / (1 + min(self.violation, MOST_VIOLATION) / VIOLATION)


def improve(transformations: Iterable[Array], matching: Matching, reach: float, method: str) -> list[Answer]:
    """Transforms (4, 4) refined on the matched clouds, within ``reach`` spacings (with method ``none`` not), scored."""
    surfaces = matching.clouds.surfaces
    aligned = [align(surfaces, start, reach, method, ITERATIONS) for start in transformations]
    return [scored(transformation, matching, sparse=method == "symmetric") for transformation in aligned]


def scored(transformation: Array, matching: Matching, *, sparse: bool) -> Answer:
    """A transform (4, 4) with all that speaks for it on the matched clouds."""
    surfaces = matching.clouds.surfaces
    mine, theirs = shares(surfaces, transformation)
    return Answer(
        transformation,
        overlap=(mine * theirs) ** 0.5,
        contained=max(mine, theirs),
        support=matching.matches.support(transformation),
        likelihood=matching.likelihood(transformation),
        border=math.exp(-MIXED * mixing(surfaces, transformation)) if sparse else 1.0,
        violation=matching.clouds.free_space.violation(transformation),
    )


def verified(answer: Answer, matching: Matching, fine: Surfaces, method: str) -> Answer:
    """An answer refined on the fine clouds, and how exactly they lie on each other."""
    surfaces = matching.clouds.surfaces
    transformation = align(fine, answer.transformation, reaches(method)[1], method, STEPS)
    close, off = exactness(fine, transformation, TOUCHING * surfaces.spacing)
    violation = matching.clouds.free_space.violation(transformation)
    share, _, _ = slippage(surfaces, transformation)
    fixed = max(0.0, float(share[0])) if len(share) else 0.0
    return replace(answer, transformation=transformation, violation=violation, close=close, off=off, fixed=fixed)


def likeliest(transformations: Array, matching: Matching, most: int, laid: int = 0) -> Array:
    """The ``most`` likeliest of the transforms (S, 4, 4) as they are, the likeliest first; none of none.

    And of the others the ``laid`` that lay most of the source on the target: features that see what one cloud alone
    shows, such as the far side of a thin part, speak against the right one.

    Next to refining an answer, to ask for its likelihood costs nothing; and to refine more of them gains nothing.
    """
    if len(transformations) == 0:
        return transformations
    likelihood, share = matching.likelihoods(transformations)
    order = np.argsort(-likelihood, kind="stable")
    best = likelihood[order[0]]
    promising = order[:most][likelihood[order[:most]] >= min(best, PROMISING * best) - SLIGHT]
    others = order[~np.isin(order, promising)]
    others = others[np.argsort(-share[others], kind="stable")[:laid]]
    return np.asarray(transformations[np.concatenate([promising, others])])


def ranked(answers: Iterable[Answer]) -> list[Answer]:
    """The best first, without those that are like a better one."""
    ordered = sorted(answers, key=lambda answer: -answer.score)
    return [ordered[n] for n in distinct(np.array([answer.transformation for answer in ordered]))]


def distinct(transformations: Array, most: int | None = None) -> NDArray[np.int64]:
    """Rows of the transforms (S, 4, 4) that are not like an earlier one, the first ``most`` of them."""
    kept: list[int] = []
    alike = np.zeros(len(transformations), bool)
    for n, one in enumerate(transformations):
        if len(kept) == most:
            break
        if not alike[n]:
            kept.append(n)
            alike |= same(one, transformations)
    return np.array(kept, np.int64)


def same(one: Array, others: Array) -> NDArray[np.bool_]:
    """Which working transforms (..., 4, 4) turn and shift the source nearly the way that one (4, 4) does."""
    cosine = (others[..., :3, :3].reshape(*others.shape[:-2], 9) @ one[:3, :3].reshape(9) - 1) / 2
    shift = others[..., :3, 3] - one[:3, 3]
    near: NDArray[np.bool_] = (cosine > np.cos(np.radians(SAME_ANGLE))) & ((shift**2).sum(-1) < SAME_SHIFT**2)
    return near
