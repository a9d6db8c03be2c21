"""The search for the answer: match, agree, refine, score; and again, on larger clouds, where it is not sure."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from idam.confidence import CLOSE, Evidence, confidence
from idam.consensus import agreeing_transforms
from idam.copies import told_apart
from idam.hypotheses import propose, starting_rotations
from idam.matching import Matching
from idam.network.features.invariant import Invariant
from idam.network.model import IDAM
from idam.pyramid import Level, Pyramid
from idam.ranking import Answer, distinct, improve, likeliest
from idam.refine import reaches
from idam.result import Matches
from idam.slippage import slid

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
    whose matches depend on the pose, is asked from many rotations.

    Args:
        clouds: in working coordinates.
        network: in evaluation mode.
        guess: (4, 4), an answer to consider, around whose rotation the network's starts turn.
        seed: of the starting rotations.
        method: of refinement, or ``none``.
        max_angle: degrees from the guess past which no transform is looked into.
    """
    candidates = [Answer(guess)]
    for level, seeds in to_match(clouds):
        matching = Matching.of(network, level)
        agreed = within(max_angle, guess, agreeing_transforms(matching.matches, seeds))
        candidates = likeliest(distinct([*candidates, *agreed], HYPOTHESES), matching, EXAMINED)
        answers = least_turned(settle(candidates, matching, reaches(method)[0], method), guess)
        found = examine(answers, matching)
        sure = confidence(found.evidence)
        if sure < SURE and method == "symmetric":
            near = partial(within, max_angle, guess)
            answers = told_apart(slid(answers, matching, near, method), matching, near)
            found = examine(answers, matching)
            sure = confidence(found.evidence)
        log.info(
            "%d feature matches of %d points: confidence %.2f", len(matching.matches.source), len(level.source), sure
        )
        if sure >= SURE:
            return found
        candidates = answers
    if isinstance(network.features, Invariant):
        return found
    starts = starting_rotations(STARTS, seed) @ torch.as_tensor(guess[:3, :3], dtype=torch.float32)
    learned = distinct(within(max_angle, guess, propose(network, clouds.small.source, clouds.small.target, starts)))
    log.info("the network, started from %d rotations, found %d transforms", len(starts), len(learned))
    answers = ranked([*answers, *settle(learned, matching, STARTED, method)])
    return examine(least_turned(answers, guess), matching)


def to_match(clouds: Pyramid) -> Iterator[tuple[Level, int]]:
    """Clouds, and from how many of their matches to grow sets of agreeing ones."""
    if not clouds.all_small:
        yield clouds.small, SEEDS[0]
    yield clouds.larger, SEEDS[1]


def within(max_angle: float, guess: Points, transformations: Iterable[Points]) -> list[Answer]:
    """The transforms (4, 4) that turn no further from the guess, in degrees, as answers."""
    least = 1 + 2 * np.cos(np.radians(max_angle)) - 1e-9  # of the trace, which falls with the angle
    return [Answer(x) for x in transformations if np.trace(guess[:3, :3].T @ x[:3, :3]) >= least]


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
