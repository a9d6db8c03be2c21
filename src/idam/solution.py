"""Two clouds to one transform: search, refine, and take the answer back to the input's coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from idam import rigid
from idam.align import align, reaches
from idam.align.information import information
from idam.align.polish import finished
from idam.align.scale import residual_scale
from idam.clouds.pyramid import Pyramid
from idam.clouds.surfaces import TOUCHING
from idam.models import Models
from idam.result import Hypothesis, Matches
from idam.rigid import Array
from idam.search.judge import Evidence, rival
from idam.search.scope import Scope
from idam.search.stages import search
from idam.search.strength import Strength, strength

__all__ = ["Solution", "solve"]

DENSE = 200_000
"""Points of each cloud that the last stage uses at most."""


@dataclass(frozen=True)
class Solution:
    """What two clouds come to, in input units.

    Attributes:
        answers: the transform to give, and the runners-up.
        evidence: what speaks for the first.
        rival: which other answer the first is least ahead of, None of an only one.
        matches: of features.
        information: (6, 6), of T exp(x), rotation before translation.
        strength: what the data fix and what they leave free.
        scale: how many times as large as the source the target looks, 1 where that is not significant.
        distance: within which points count as inliers.
        source_misses: the distance from each point of the thinned source, moved by the answer, to the target, (N,).
        target_misses: likewise from the target to the source, (P,).
    """

    answers: list[Hypothesis]
    evidence: Evidence
    rival: int | None
    matches: Matches
    information: Array
    strength: Strength
    scale: float
    distance: float
    source_misses: Array
    target_misses: Array

    @property
    def fitness(self) -> float:
        """Share of the source's points that are inliers."""
        return float((self.source_misses <= self.distance).mean())

    @property
    def inlier_rmse(self) -> float:
        """Root mean square distance of the inliers, 0 where there is none."""
        inliers = self.source_misses[self.source_misses <= self.distance]
        return float(np.sqrt(np.mean(inliers**2))) if len(inliers) else 0.0

    def inverted(self) -> Solution:
        """The same with source and target exchanged."""
        answers = [replace(answer, transformation=rigid.inverse(answer.transformation)) for answer in self.answers]
        change = -rigid.adjoint(self.answers[0].transformation)  # (T exp(x))^-1 = T^-1 exp(-Ad x)
        return replace(
            self,
            answers=answers,
            matches=Matches(self.matches.target, self.matches.source, self.matches.weight),
            information=rigid.carried(self.information, change),
            strength=self.strength.carried(change),
            scale=1 / self.scale,
            source_misses=self.target_misses,
            target_misses=self.source_misses,
        )


def solve(clouds: Pyramid, models: Models, guess: Array | None, max_angle: float, refine: str | None) -> Solution:
    """Lay the source of a pyramid on its target.

    Args:
        clouds: both, at several resolutions.
        models: the descriptor, and a network where one is named.
        guess: (4, 4) in input units, or None.
        max_angle: largest rotation in degrees, from the guess.
        refine: method of fine alignment, or None.
    """
    method = "symmetric" if refine == "gicp" and clouds.sparse else refine or "none"
    scope = Scope(np.eye(4) if guess is None else clouds.enter(guess), max_angle, given=guess is not None)
    found = search(clouds, models.descriptors, models.asked(clouds.small), scope, method)
    surfaces, unit, matches = clouds.fine.surfaces, clouds.unit, found.matching.matches
    last = refine == "gicp"  # unless another method is asked for, the last stage takes over from the search
    start = found.best if last and method != "symmetric" else align(surfaces, found.best, reaches(method)[1], method)
    best, pairs = finished(surfaces, lambda: dense(clouds), start, method, last)
    first, *others = found.answers
    found = replace(found, answers=[replace(first, transformation=best), *others])
    return Solution(
        answers=[Hypothesis(clouds.leave(answer.transformation), answer.score) for answer in found.answers],
        evidence=found.evidence,
        rival=rival(found.answers),
        matches=Matches(
            matches.source * unit + clouds.source.centre,
            matches.target * unit + clouds.target.centre,
            found.weights,
        ),
        information=clouds.information_left(information(pairs)),
        strength=strength(surfaces, best).carried(clouds.to_input / unit),
        scale=residual_scale(surfaces, best, pairs),
        distance=TOUCHING * surfaces.spacing * unit,
        source_misses=unit * surfaces.nearest(best)[0],
        target_misses=unit * surfaces.swapped.nearest(rigid.inverse(best))[0],
    )


def dense(clouds: Pyramid) -> tuple[Array, Array]:
    """Both clouds in working units with all points, or every n-th."""
    source, target = (cloud.every(DENSE) / clouds.unit for cloud in (clouds.source, clouds.target))
    return source, target
