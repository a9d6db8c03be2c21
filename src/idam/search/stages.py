"""The search for the answer, in stages: match, agree, refine, score; again, on larger clouds, where it is not sure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from idam import rigid
from idam.align import align, reaches
from idam.clouds.prepared import Describes
from idam.clouds.pyramid import PairLevel, Pyramid
from idam.clouds.surfaces import Surfaces
from idam.rigid import Array
from idam.search.confidence import CLOSE, Evidence, confidence
from idam.search.consensus import agreeing_transforms
from idam.search.matching import Matching
from idam.search.ranking import Answer, distinct, improve, likeliest, ranked, same
from idam.search.scope import Scope

__all__ = ["Found", "Network", "search"]

log = logging.getLogger(__name__)

Network = Callable[[Array], Array]
"""A network of the paper's kind: from a guess (4, 4) in working coordinates to its answer (4, 4)."""

SEEDS = 200, 600
"""Matches that sets of agreeing ones are grown from, on the small clouds and on the larger ones."""
HYPOTHESES = 64
"""Different transforms, among those that the sets agree on, whose likelihood is asked for."""
EXAMINED = 8
"""The likeliest of them, which are refined."""
CONTENDERS = 6
"""Answers that are kept, and that stay in the race against what larger clouds say."""
TAUGHT = 90.0
"""Degrees that the pairs which a network of the paper's kind is taught are turned at most."""
NEAR = 20.0
"""Degrees from such a network's answer within which transforms are looked into."""
APART, APART_SHIFT = 30.0, 0.3
"""Degrees and working units past which refinement does not carry one answer to another."""
SURE = 0.9
"""Confidence from which no larger clouds are matched."""


@dataclass(frozen=True)
class Found:
    """What the search found, in working coordinates.

    Attributes:
        answers: the one to give first, and then those that are not like it, the best first.
        matching: of the clouds that they were scored on.
    """

    answers: list[Answer]
    matching: Matching

    @property
    def best(self) -> Array:
        """The transform (4, 4) to give."""
        return self.answers[0].transformation

    @property
    def evidence(self) -> Evidence:
        """What speaks for the best answer."""
        best, second = self.answers[0], max((answer.score for answer in self.answers[1:]), default=0.0)
        margin = max(0.0, 1.0 - second / best.score) if best.score > 0 else 0.0
        return Evidence(best.overlap, best.support, best.likelihood, margin)

    @property
    def weights(self) -> Array:
        """How well the best answer brings each match together, (M,), sum 1, or 0 where it brings none."""
        weight = self.matching.matches.weights(self.best)
        return weight / (weight.sum() or 1.0)

    def with_best(self, transformation: Array) -> Found:
        """With another transform (4, 4) for the best answer."""
        first, *others = self.answers
        return replace(self, answers=[replace(first, transformation=transformation), *others])

    def refined(self, fine: Surfaces, method: str) -> Found:
        """With the best answer refined on finer clouds, and without others that end where it does.

        Two answers that started apart may be one that had not come to rest.
        """
        if method == "none":
            return self
        first, *others = self.answers
        reach = reaches(method)[1]
        best = replace(first, transformation=align(fine, first.transformation, reach, method))
        left = [
            other
            for other in others
            if not (
                near(other.transformation, best.transformation)
                and same(best.transformation, align(fine, other.transformation, reach, method))
            )
        ]
        return Found([best, *left], self.matching)


def search(clouds: Pyramid, descriptor: Describes, network: Network | None, scope: Scope, method: str) -> Found:
    """The answers that explain both clouds best.

    Small clouds are matched first: that costs least, and mostly it is enough. Where it does not settle the matter,
    larger ones are; the best answers so far have to stand against what they say. At last a network of the paper's kind,
    where there is one, has a say.

    Args:
        clouds: in working coordinates.
        descriptor: makes the features that points are matched by.
        network: asked from the guess.
        scope: the transforms to look into; its guess is an answer to consider.
        method: of refinement, or ``none``.
    """
    candidates = scope.guess[None]
    for level, seeds in to_match(clouds):
        matching = Matching.of(descriptor, level)
        agreed = scope.within(agreeing_transforms(matching.matches, seeds))
        found = explain(np.concatenate([candidates, agreed]), matching, scope, method)
        sure = confidence(found.evidence)
        log.info(
            "%d feature matches of %d points: confidence %.2f", len(matching.matches.source), len(level.source), sure
        )
        if sure >= SURE:
            return found
        candidates = np.array([answer.transformation for answer in found.answers])
    return found if network is None else choose(network, found, agreed, matching, scope, method)


def choose(network: Network, found: Found, agreed: Array, matching: Matching, scope: Scope, method: str) -> Found:
    """Of poses that look alike, the one that a network of the paper's kind may have learnt is meant.

    It is asked from the guess. Where nothing turns by more than it was taught, what is found near its answer comes
    first if it would be surer with all else ruled out; yet in how sure it is, all else counts. Where more is in scope,
    its answer is one among others.
    """
    asked = scope.within(network(scope.guess)[None])
    if len(asked) == 0:
        return found
    if scope.max_angle > TAUGHT:
        tried = improve(asked, matching, reaches(method)[0], method)
        return Found(least_turned(ranked([*found.answers, *tried]), scope.guess), matching)
    nearby = scope.around(asked[0], NEAR)
    near = explain(np.concatenate([asked, nearby.within(agreed)]), matching, nearby, method)
    surer = confidence(near.evidence)
    log.info("near the network's answer, all else ruled out: confidence %.2f", surer)
    if surer < confidence(found.evidence):
        return found
    best, *others = near.answers
    return Found(first_of_its_kind([best, *ranked([*others, *found.answers])]), matching)


def explain(candidates: Array, matching: Matching, scope: Scope, method: str) -> Found:
    """What the likeliest of the candidates (S, 4, 4) come to: refined, scored and looked at closely."""
    tried = likeliest(candidates[distinct(candidates, HYPOTHESES)], matching, EXAMINED)
    answers = ranked(improve(tried, matching, reaches(method)[0], method))[:CONTENDERS]
    log.info("refined and scored: %d, best overlap %.2f", len(answers), max((a.overlap for a in answers), default=0.0))
    return Found(least_turned(answers, scope.guess), matching)


def to_match(clouds: Pyramid) -> Iterator[tuple[PairLevel, int]]:
    """Clouds, and from how many of their matches to grow sets of agreeing ones."""
    if not clouds.all_small:
        yield clouds.small, SEEDS[0]
    yield clouds.larger, SEEDS[1]


def first_of_its_kind(answers: list[Answer]) -> list[Answer]:
    """The answers without those that are like an earlier one."""
    return [answers[n] for n in distinct(np.array([answer.transformation for answer in answers]))]


def least_turned(answers: list[Answer], guess: Array) -> list[Answer]:
    """The answers, first the one nearest to the guess of those that explain the clouds as well as the best.

    Something has to choose among the poses of a symmetric object, and scans stand upright more often than not.
    """
    tied = [answer for answer in answers if answer.score >= (1 - CLOSE) * answers[0].score]
    first = min(tied, key=lambda answer: float(rigid.angle(guess[:3, :3].T @ answer.transformation[:3, :3])))
    return [first, *(answer for answer in answers if answer is not first)]


def near(one: Array, other: Array) -> bool:
    """Whether two working transforms (4, 4) may be one that has not come to rest."""
    turned = rigid.angle(one[:3, :3].T @ other[:3, :3])
    shift = np.linalg.norm(one[:3, 3] - other[:3, 3])
    return bool(turned < np.radians(APART) and shift < APART_SHIFT)
