"""Poses that explain two clouds equally well, told apart by copies of points.

A vase turned about its axis looks the same, and so does a door slid along itself; neither features nor surfaces tell
one pose from the other. Two clouds that were sampled together, as those of the paper's protocol, still do: most points
of one are copies of the other's, but for noise, and only the right pose lays points nearer to each other than
unrelated points of one surface lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from idam.align import TOUCHING, Surfaces, align
from idam.search.matching import Matching
from idam.search.ranking import Answer, distinct, scored
from idam.search.sparse.slippage import slips

__all__ = ["nearer", "told_apart"]

Points = NDArray[np.float64]

DECISIVE = 20.0
"""Nats by which one pose must lay points nearer than another to rule it out."""
SLIPPABLE = 0.04
"""Mean square, per mean square of a motion, of what it moves along the normals, below which a surface slips."""
TRIED = 3
"""Slipped poses, those that lay points nearest, that are refined."""


def told_apart(
    answers: list[Answer], matching: Matching, within: Callable[[Iterable[Points]], list[Answer]]
) -> list[Answer]:
    """The answers, and slipped poses of the first, without those that lay points decidedly farther from each other.

    Args:
        answers: the best first, refined on the matched clouds, which are to have all points of sparse scans.
        matching: of these clouds.
        within: leaves out transforms that turn too far, and makes answers of the others.

    Returns:
        The answers as they are where none is ruled out; else those that are left, the decided one first.
    """
    surfaces = matching.clouds.surfaces
    slipped = [answer.transformation for answer in within(slips(surfaces, answers[0].transformation, SLIPPABLE))]
    near = [_together(squares, surfaces.spacing) for squares in _squares(surfaces, slipped)]
    starts = [answer.transformation for answer in answers] + [slipped[n] for n in np.argsort(near)[::-1][:TRIED]]
    poses = [align(surfaces, start, 1.0, "point")[0] for start in starts]
    squares = _squares(surfaces, poses)
    best = 0
    for other in range(1, len(poses)):
        if nearer(squares[other], squares[best]) > DECISIVE:
            best = other
    left = [n for n in range(len(answers)) if n != best and nearer(squares[best], squares[n]) <= DECISIVE]
    if best == 0 and len(left) == len(answers) - 1:
        return answers
    return distinct([scored(poses[best], matching, sparse=True), *(answers[n] for n in left)])


def nearer(one: Points, other: Points) -> float:
    """By how many nats the squared distances (N,) of points laid on each other are less in one pose than in another.

    Of unrelated points of one surface, squared distances are distributed exponentially, by their density alone; this
    is the logarithm of the likelihoods of one's under either mean. Negative where they are no less, or fewer points are
    laid on each other.
    """
    ratio = one.mean() / max(float(other.mean()), np.finfo(float).tiny) if len(one) and len(other) else 1.0
    if ratio >= 1.0 or len(one) < 0.8 * len(other):
        return -1.0
    return float(len(one) * (ratio - 1 - np.log(max(ratio, np.finfo(float).tiny))))


def _squares(surfaces: Surfaces, poses: list[Points]) -> list[Points]:
    """For each transform (4, 4) the squared distances of the source points that it lays on the target."""
    distance, _ = surfaces.to_target(np.reshape(poses, (-1, 4, 4)))
    return [row[np.isfinite(row)] ** 2 for row in distance]


def _together(squares: Points, spacing: float) -> float:
    """How many points lie on each other, and how near."""
    return float((1 - squares / (TOUCHING * spacing) ** 2).sum())
