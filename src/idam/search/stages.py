"""The search for the answer, in stages: match, agree, refine, score; again, on larger clouds, where it is not sure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from idam import rigid
from idam.align import align, reaches
from idam.clouds.prepared import FINE, SPARSE
from idam.clouds.pyramid import PairLevel, Pyramid
from idam.clouds.surfaces import Surfaces
from idam.describe.invariant import Descriptor
from idam.rigid import Array
from idam.search.consensus import agreeing_transforms
from idam.search.judge import Evidence, confidence, evidence, geometric_weight, weight
from idam.search.matching import Matching
from idam.search.point_pairs import point_pair_transforms
from idam.search.ranking import Answer, distinct, improve, likeliest, ranked, scored, verified
from idam.search.repeats import repeats
from idam.search.scope import Scope
from idam.search.slides import held, slides

__all__ = ["Found", "Network", "search"]

log = logging.getLogger(__name__)

Network = Callable[[Array], Array]
"""A network of the paper's kind: from a guess (4, 4) in working coordinates to its answer (4, 4)."""

SEEDS, SPARSE_SEEDS = 200, 600
"""Matches that sets of agreeing ones are grown from. With 600 as many answers of 108 ray-cast pairs are right, and it
takes longer; of sparse clouds, fewer miss some of a symmetric object's poses."""
HYPOTHESES, EXAMINED = 64, (8, 0)
"""Different transforms that sets of matches agree on, whose likelihood is asked for; and those of them that are
refined: the likeliest, and besides some that lay most of the source on the target."""
MORE, CLOSELY = 300, (16, 4)
"""The same where these do not settle the matter: so many that sets grown from every match agree on, and as many of
every two matches; and as many refined of all of them together. Of 62 real pairs cropped to a seventh to a third of
overlap, the right one is among the likeliest 16 of the larger clouds for 49, and was for 39. Of two scans of thin
objects on their models, it is the 12th and the 268th likeliest, and the one that lays most of the scan on the model."""
SLID = 6
"""The likeliest of the poses that the best answer may be mistaken for, which are refined, too."""
CONTENDERS = 8
"""Answers that are kept, and that stay in the race against what larger clouds say; no fewer than are looked at."""
TAUGHT = 90.0
"""Degrees that the pairs which a network of the paper's kind is taught are turned at most."""
NEAR = 20.0
"""Degrees from such a network's answer within which transforms are looked into."""
HOMING = 8.0, 4.0, 2.0
"""Spacings within which points pull on each other from a caller's guess."""
VERIFIED = 4
"""Answers at most that are refined on the fine clouds before one is chosen."""
CONTENDS = 0.3
"""Share of the best score from which on an answer is refined on the fine clouds, too."""
FIRMEST = 2
"""Answers that the surfaces speak for most, which are refined so, too."""
TIED, APART = 0.2, 30.0
"""Logits by which answers are as likely as the best: a symmetric object's poses differ by chance. And degrees from the
best from which on they may be such poses: two that are nearer are two attempts at one (of an indoor pair, 10 degrees
apart, the worse one was nearer to the guess)."""
STARVED = 400
"""Points of the smaller cloud, of clouds of different extent, below which both are matched at its own scale. A LiDAR at
a car's side and the one on its roof: 154 of 1780 points, none of 113 matches right; 709 of 8374, 45 of 600, and right
with 0.9."""
SURE = 0.9
"""Confidence from which no larger clouds are matched."""


@dataclass(frozen=True)
class Found:
    """What the search found, in working coordinates.

    Attributes:
        answers: the one to give first, and then those that are not like it, the best first.
        matching: of the clouds that they were scored on.
        slides: whether what the best one lays on each other may slide along itself.
    """

    answers: list[Answer]
    matching: Matching
    slides: bool = False

    @property
    def best(self) -> Array:
        """The transform (4, 4) to give."""
        return self.answers[0].transformation

    @cached_property
    def evidence(self) -> Evidence:
        """What speaks for the best answer."""
        return evidence(self.answers)

    @property
    def weights(self) -> Array:
        """How well the best answer brings each match together, (M,), sum 1, or 0 where it brings none."""
        weight = self.matching.matches.weights(self.best)
        return weight / (weight.sum() or 1.0)


def search(
    clouds: Pyramid, descriptors: Sequence[Descriptor], network: Network | None, scope: Scope, method: str
) -> Found:
    """The answers that explain both clouds best.

    Small clouds are matched first, and sets of matches asked that agree in their distances: that costs least, and
    mostly it is enough. Where it does not settle the matter, every two matches are asked, and then larger clouds, those
    of different extent at the scale of the smaller, and sparse ones by other features; the best answers so far have to
    stand against what they say. At last a network of the paper's kind, where there is one, has a say.

    Args:
        clouds: in working coordinates.
        descriptors: make the features that points are matched by; those after the first are for sparse clouds.
        network: asked from the guess.
        scope: the transforms to look into; its guess is an answer to consider.
        method: of refinement, or ``none``.
    """
    poses = scope.guess[None]
    for level, descriptor in to_match(clouds, descriptors):
        matching = Matching.of(descriptor, level)
        few = level is clouds.small and not clouds.all_small
        for agreed, most in proposals(matching, scope, SPARSE_SEEDS if clouds.sparse else SEEDS):
            found = explain(np.concatenate([poses, agreed]), matching, scope, method, clouds.fine.surfaces, most)
            sure = confidence(found.evidence)
            log.info("%d matches of %d points: confidence %.2f", len(matching.matches.source), len(level.source), sure)
            if sure >= SURE and not (found.slides and few):  # what slides can look settled by few points
                return found
            poses = np.array([answer.transformation for answer in found.answers])
    if network is None:
        return found
    return choose(network, found, agreed, matching, scope, method, clouds.fine.surfaces)


def proposals(matching: Matching, scope: Scope, seeds: int) -> Iterator[tuple[Array, tuple[int, int]]]:
    """Different transforms (S, 4, 4) that matches agree on, and how many of them to refine: a few, and then more."""
    matches, surfaces = matching.matches, matching.clouds.surfaces
    few = scope.within(agreeing_transforms(matches, seeds))
    yield few[distinct(few, HYPOTHESES)], EXAMINED
    every = len(matches.source)
    grown = few if every <= seeds else scope.within(agreeing_transforms(matches, every))
    more = grown, scope.within(point_pair_transforms(matches, surfaces))
    yield np.concatenate([transforms[distinct(transforms, MORE)] for transforms in more]), CLOSELY


def choose(
    network: Network, found: Found, agreed: Array, matching: Matching, scope: Scope, method: str, fine: Surfaces
) -> Found:
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
        answers = judged(ranked([*found.answers, *tried]), matching, method, fine)
        return Found(smallest_rotation(answers, scope.guess), matching)
    nearby = scope.around(asked[0], NEAR)
    near = explain(np.concatenate([asked, nearby.within(agreed)]), matching, nearby, method, fine, CLOSELY)
    surer = confidence(near.evidence)
    log.info("near the network's answer, all else ruled out: confidence %.2f", surer)
    if surer < confidence(found.evidence):
        return found
    best, *others = near.answers
    return Found(first_of_its_kind([best, *ranked([*others, *found.answers])]), matching)


def explain(
    candidates: Array, matching: Matching, scope: Scope, method: str, fine: Surfaces, most: tuple[int, int]
) -> Found:
    """What the best candidates (S, 4, 4), so many at most, come to: refined, scored and looked at closely."""
    tried = likeliest(candidates[distinct(candidates)], matching, *most)
    if scope.given:
        tried = np.concatenate([homed(scope.guess, matching)[None], tried])
    answers = ranked(improve(tried, matching, reaches(method)[0], method))
    surfaces, best = matching.clouds.surfaces, answers[0].transformation
    slid, shifted = scope.within(slides(surfaces, best)), scope.within(repeats(fine, matching.clouds.free_space, best))
    rivals = np.concatenate([likeliest(slid, matching, SLID), shifted])
    answers = ranked([*answers, *improve(rivals, matching, reaches(method)[0], method)])
    log.info("refined and scored: %d, best overlap %.2f", len(answers), max((a.overlap for a in answers), default=0.0))
    answers = smallest_rotation(judged(answers, matching, method, fine), scope.guess)
    return Found(answers, matching, slides=len(slid) > 0)


def homed(guess: Array, matching: Matching) -> Array:
    """A guess (4, 4) drawn near from farther away than candidates are, which are nearly right or wrong altogether."""
    for reach in HOMING:
        guess = align(matching.clouds.surfaces, guess, reach, "gicp")
    return guess


def judged(answers: list[Answer], matching: Matching, method: str, fine: Surfaces) -> list[Answer]:
    """The answers, the best first, those that may be right refined on the fine clouds.

    Those that the surfaces speak for most may be, whatever the features say. Two that started apart may be one that had
    not come to rest.
    """
    contenders = [answer for answer in answers[:VERIFIED] if answer.score >= CONTENDS * answers[0].score]
    firmest = sorted(answers, key=lambda answer: -geometric_weight(answer))
    contenders += [answer for answer in firmest[:FIRMEST] if answer not in contenders]
    rest = [answer for answer in answers if answer not in contenders][: CONTENDERS - len(contenders)]
    contenders += held_poses(contenders, matching, fine, method)
    contenders = [verified(answer, matching, fine, method) for answer in contenders]
    return first_of_its_kind([*sorted(contenders, key=lambda answer: -weight(answer)), *rest])


def held_poses(answers: list[Answer], matching: Matching, fine: Surfaces, method: str) -> list[Answer]:
    """Where what fixes the place would have answers that slide: others to choose among, and no better yet."""
    poses = [held(matching.clouds.surfaces, fine, answer.transformation) for answer in answers]
    new = [pose for pose, answer in zip(poses, answers, strict=True) if (pose != answer.transformation).any()]
    return [scored(pose, matching, sparse=method == "symmetric") for pose in new]


def to_match(clouds: Pyramid, descriptors: Sequence[Descriptor]) -> Iterator[tuple[PairLevel, Descriptor]]:
    """The clouds to match, the smallest first, and the descriptors of their features."""
    first, *others = descriptors
    if not clouds.all_small:
        yield clouds.small, first
    yield clouds.larger, first
    shared = of_the_smaller(clouds)
    if shared is not None:
        yield shared, first
    if clouds.sparse:
        yield from ((clouds.small, other) for other in others)


def of_the_smaller(clouds: Pyramid) -> PairLevel | None:
    """Both clouds as fine as the one of less extent is matched best; None where the larger one's scale leaves enough.

    The larger cloud has as many points more as it is larger, up to the number of the last refinement.
    """
    if clouds.voxel_size is not None or min(len(clouds.larger.source), len(clouds.larger.target)) >= STARVED:
        return None
    both = clouds.source, clouds.target
    finer = max(min(cloud.voxel_size(SPARSE) for cloud in both), max(cloud.voxel_size(FINE) for cloud in both))
    return clouds.at(finer) if finer < clouds.larger.source_level.voxel_size else None


def first_of_its_kind(answers: list[Answer]) -> list[Answer]:
    """The answers without those that are like an earlier one."""
    return [answers[n] for n in distinct(np.array([answer.transformation for answer in answers]))]


def smallest_rotation(answers: list[Answer], guess: Array) -> list[Answer]:
    """The answers, first the one nearest to the guess of those that are as likely to be right as the best.

    Something has to choose among the poses of a symmetric object, and scans stand upright more often than not.
    """

    def turned(answer: Answer, pose: Array) -> float:
        return float(np.degrees(rigid.angle(pose[:3, :3].T @ answer.transformation[:3, :3])))

    best, *others = answers
    least = weight(best) - TIED
    tied = [other for other in others if weight(other) >= least and turned(other, best.transformation) > APART]
    first = min([best, *tied], key=lambda answer: turned(answer, guess))
    return [first, *(answer for answer in answers if answer is not first)]
