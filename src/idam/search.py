"""The search for the answer: propose, refine, score; and once more, harder, where the answer does not look sure."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from idam.confidence import Evidence, confidence
from idam.consensus import FeatureMatches, agreeing_transforms, match_features
from idam.hypotheses import propose, starting_rotations
from idam.network.model import IDAM
from idam.pyramid import Pyramid
from idam.ranking import Answer, distinct, improve
from idam.result import Matches

__all__ = ["Found", "inverse", "search"]

log = logging.getLogger(__name__)

Points = NDArray[np.float64]

STARTS = 24
"""Rotations of the source that the network starts from."""
HYPOTHESES = 16
"""Different transforms that feature matches agree on that are looked into."""
CONTENDERS = 8
"""Answers that stay in the race on the dense clouds."""
SURE = 0.95
"""Confidence from which no other proposer is asked."""


@dataclass(frozen=True)
class Found:
    """What the search found, in working coordinates.

    Attributes:
        answers: the best first, and those that are not like it.
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


def search(clouds: Pyramid, network: IDAM, guess: Points, seed: int, method: str) -> Found:
    """The answers that explain both clouds best.

    Transforms that many feature matches agree on come first: they cost least. The network, started from many rotations,
    is asked where they do not settle the matter.

    Args:
        clouds: in working coordinates.
        network: in evaluation mode.
        guess: (4, 4), an answer to consider, around whose rotation the network's starts turn.
        seed: of the starting rotations.
        method: of refinement, or ``none``.
    """
    matches = match_features(clouds.matching.source, clouds.matching.target, clouds.matching.spacing)
    agreed = distinct(map(Answer, [guess, *agreeing_transforms(matches)]), HYPOTHESES)
    log.info("%d feature matches, sets of which agree on %d transforms", len(matches.source), len(agreed) - 1)
    answers = settle(agreed, clouds, matches, 2.0, method)
    found = examine(answers, matches)
    if confidence(found.evidence) >= SURE:
        return found
    starts = starting_rotations(STARTS, seed) @ torch.as_tensor(guess[:3, :3], dtype=torch.float32)
    learned = distinct(map(Answer, propose(network, clouds.small.source, clouds.small.target, starts)))
    log.info("the network, started from %d rotations, found %d transforms", len(starts), len(learned))
    return examine(ranked([*answers, *settle(learned, clouds, matches, 4.0, method)]), matches)


def settle(answers: list[Answer], clouds: Pyramid, matches: FeatureMatches, reach: float, method: str) -> list[Answer]:
    """Refine and score answers, on coarse clouds all, within ``reach`` spacings, and on dense ones the best."""
    answers = ranked(improve(answers, clouds.matching.surfaces, matches, reach, method))
    answers = ranked(improve(answers[:CONTENDERS], clouds.dense.surfaces, matches, 2.0, method))
    log.info("refined and scored: best overlap %.2f, %d others", answers[0].overlap, len(answers) - 1)
    return answers


def ranked(answers: Iterable[Answer]) -> list[Answer]:
    """The best first, without those that are like a better one."""
    return distinct(sorted(answers, key=lambda answer: -answer.score))


def examine(answers: list[Answer], matches: FeatureMatches) -> Found:
    """Look at the best answer more closely: how sure it is, and which matches speak for it."""
    best, second = answers[0], answers[1].score if len(answers) > 1 else 0.0
    margin = 1.0 - second / best.score if best.score > 0 else 0.0
    evidence = Evidence(best.overlap, best.support, margin)
    weight = matches.weights(best.transformation)
    weight /= weight.sum() or 1.0
    return Found(answers, Matches(*matches.points, weight), evidence)
