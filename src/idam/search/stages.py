"""The search for the answer: match, agree, refine, score; and again, on larger clouds, where it is not sure."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from idam.align import reaches
from idam.clouds.pyramid import Level, Pyramid
from idam.network.features.invariant import Invariant
from idam.network.model import IDAM
from idam.network.propose import propose, starting_rotations
from idam.result import Matches
from idam.search.confidence import CLOSE, Evidence, confidence
from idam.search.consensus import agreeing_transforms
from idam.search.matching import Matching
from idam.search.ranking import Answer, distinct, improve, likeliest
from idam.search.scope import Scope
from idam.search.sparse.copies import told_apart
from idam.search.sparse.slippage import slid

__all__ = ["Found", "inverse", "search"]

log = logging.getLogger(__name__)

Points = NDArray[np.float64]

STARTS = 24
"""Rotations of the source that a network of the paper's kind starts from."""
SEEDS = 200, 600
"""Matches that sets of agreeing ones are grown from, on the small clouds and on the larger ones."""
HYPOTHESES = 64
"""Different transforms, among those that the sets agree on, whose likelihood is asked for."""
EXAMINED = 8
"""The likeliest of them, which are refined."""
CONTENDERS = 6
"""Answers that are kept, and that stay in the race against what larger clouds say."""
STARTED = 4.0
"""Spacings within which points pull on each other after the network."""
TAUGHT = 90.0
"""Degrees that the pairs which a network of the paper's kind is taught are turned at most."""
NEAR = 20.0
"""Degrees from such a network's answer within which transforms are looked into."""
SURE = 0.9
"""Confidence from which no larger clouds are matched."""


@dataclass(frozen=True)
class Found:
    """What the search found, in working coordinates.

    Attributes:
        answers: the one to give first, and then those that are not like it, the best first.
        matches: of features, weighted by how well the best answer brings them together.
        evidence: what speaks for the best answer.
    """

    answers: list[Answer]
    matches: Matches
    evidence: Evidence

    def inverted(self) -> Found:
        """The same with source and target exchanged."""
        answers = [replace(answer, transformation=inverse(answer.transformation)) for answer in self.answers]
        matches = Matches(self.matches.target, self.matches.source, self.matches.weight)
        return Found(answers, matches, self.evidence)


def inverse(transformation: Points) -> Points:
    """The inverse (4, 4) of a rigid transform."""
    rotation = transformation[:3, :3].T
    return np.block([[rotation, -rotation @ transformation[:3, 3:]], [0.0, 0.0, 0.0, 1.0]])


def search(clouds: Pyramid, network: IDAM, guess: Points, seed: int, method: str, max_angle: float = 180.0) -> Found:
    """The answers that explain both clouds best.

    Small clouds are matched first: that costs least, and mostly it is enough. Where it does not settle the matter,
    larger ones are; the best answers so far have to stand against what they say. At last a network of the paper's kind,
    whose matches depend on the pose, is asked from many rotations. But where nothing is turned by more than it was
    taught, it is first asked from the guess alone: of poses that look alike it may have learnt which is meant. What is
    found near its answer is taken where it would be surer with all else ruled out; yet how sure it is, all else counts.

    Args:
        clouds: in working coordinates.
        network: in evaluation mode.
        guess: (4, 4), an answer to consider, around whose rotation the network's starts turn.
        seed: of the starting rotations.
        method: of refinement, or ``none``.
        max_angle: degrees from the guess past which no transform is looked into.
    """
    scope, candidates = Scope(guess, max_angle), [Answer(guess)]
    for level, seeds in to_match(clouds):
        matching = Matching.of(network, level)
        agreed = agreeing_transforms(matching.matches, seeds)
        found = explain([*candidates, *scope.within(agreed)], matching, scope, method)
        sure = confidence(found.evidence)
        log.info(
            "%d feature matches of %d points: confidence %.2f", len(matching.matches.source), len(level.source), sure
        )
        if sure >= SURE:
            return found
        candidates = found.answers
    if isinstance(network.features, Invariant):
        return found
    for answer in scope.within(ask_once(network, clouds, guess)) if max_angle <= TAUGHT else []:
        nearby = scope.around(answer.transformation, NEAR)
        near = explain([answer, *nearby.within(agreed)], matching, nearby, method)
        surer = confidence(near.evidence)
        log.info("near the network's answer, all else ruled out: confidence %.2f", surer)
        if surer >= sure:
            best, *others = near.answers
            return examine(distinct([best, *ranked([*others, *found.answers])]), matching)
    starts = scope.turns(starting_rotations(STARTS, seed))
    learned = distinct(scope.within(propose(network, clouds.small.source, clouds.small.target, starts)))
    log.info("the network, started from %d rotations, found %d transforms", len(starts), len(learned))
    answers = ranked([*found.answers, *settle(learned, matching, STARTED, method)])
    return examine(least_turned(answers, guess), matching)


def ask_once(network: IDAM, clouds: Pyramid, guess: Points) -> list[Points]:
    """What the network makes of the caller's source and target, starting from the guess.

    Not of the two exchanged: of the pairs that it was taught, the source stands as the data's shapes do, and it may
    have come to count on that (``gnn-practice`` has: see docs/architecture.md).
    """
    turn = torch.as_tensor(guess[None, :3, :3], dtype=torch.float32)
    if clouds.exchanged:
        return [inverse(x) for x in propose(network, clouds.small.target, clouds.small.source, turn.mT)]
    return propose(network, clouds.small.source, clouds.small.target, turn)


def explain(candidates: Iterable[Answer], matching: Matching, scope: Scope, method: str) -> Found:
    """What the likeliest of the candidates come to: refined, scored and looked at closely."""
    tried = likeliest(distinct(candidates, HYPOTHESES), matching, EXAMINED)
    answers = least_turned(settle(tried, matching, reaches(method)[0], method), scope.guess)
    found = examine(answers, matching)
    if method == "symmetric" and confidence(found.evidence) < SURE:
        answers = told_apart(slid(answers, matching, scope.within, method), matching, scope.within)
        found = examine(answers, matching)
    return found


def to_match(clouds: Pyramid) -> Iterator[tuple[Level, int]]:
    """Clouds, and from how many of their matches to grow sets of agreeing ones."""
    if not clouds.all_small:
        yield clouds.small, SEEDS[0]
    yield clouds.larger, SEEDS[1]


def settle(answers: list[Answer], matching: Matching, reach: float, method: str) -> list[Answer]:
    """Refine and score answers on the matched clouds, within ``reach`` spacings: the best of them, the best first."""
    answers = ranked(improve(answers, matching, reach, method))[:CONTENDERS]
    log.info("refined and scored: %d, best overlap %.2f", len(answers), max((a.overlap for a in answers), default=0.0))
    return answers


def ranked(answers: Iterable[Answer]) -> list[Answer]:
    """The best first, without those that are like a better one."""
    return distinct(sorted(answers, key=lambda answer: -answer.score))


def least_turned(answers: list[Answer], guess: Points) -> list[Answer]:
    """The answers, first the one nearest to the guess of those that explain the clouds as well as the best.

    Something has to choose among the poses of a symmetric thing, and scans stand upright more often than not.
    """
    tied = [answer for answer in answers if answer.score >= (1 - CLOSE) * answers[0].score]
    first = max(tied, key=lambda answer: float(np.trace(guess[:3, :3].T @ answer.transformation[:3, :3])))
    return [first, *(answer for answer in answers if answer is not first)]


def examine(answers: list[Answer], matching: Matching) -> Found:
    """Look at the best answer more closely: how sure it is, and which matches speak for it."""
    best, second = answers[0], max((answer.score for answer in answers[1:]), default=0.0)
    margin = max(0.0, 1.0 - second / best.score) if best.score > 0 else 0.0
    evidence = Evidence(best.overlap, best.support, best.likelihood, margin)
    weight = matching.matches.weights(best.transformation)
    weight /= weight.sum() or 1.0
    return Found(answers, Matches(*matching.matches.points, weight), evidence)
