"""Which pairs of scans to register: all of a few scans, the likeliest of many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from idam.many.scans import Scan, described
from idam.rigid import Array

__all__ = ["ALL_PAIRS", "PARTNERS", "Choice", "all_pairs", "likeliest", "likeliness", "vote"]

ALL_PAIRS = 30
"""Scans up to which every pair is registered."""
PARTNERS = 8
"""Likeliest partners of each scan that are registered where there are more scans."""
MORE = 2
"""How often scans that are left unsure look for as many partners more."""
VOTERS = 256
"""Points of a scan that vote on whether another shows the same place."""
AGREE = 2.0
"""Spacings of the voters by which distances between two matches may differ in the two scans."""


class Choice:
    """Which pairs to register next, round by round.

    Args:
        scans: all of them.
        partners: likely partners of each to begin with; None to choose.
    """

    def __init__(self, scans: Sequence[Scan], partners: int | None):
        self._count, self._partners = len(scans), partners or PARTNERS
        every = partners is None and len(scans) <= ALL_PAIRS
        self._scores = None if every else likeliness(*described(scans))
        self._tried: set[tuple[int, int]] = set()
        self._round = 0

    def pairs(self, unsure: Sequence[int] | None) -> list[tuple[int, int]]:
        """The pairs of the next round, source and target; none where there is no more to try.

        Args:
            unsure: scans left without a sure place by the rounds before; None at first.
        """
        self._round += 1
        if self._scores is None:
            return all_pairs(self._count) if self._round == 1 else []
        if self._round > 1 + MORE:
            return []
        looking = range(self._count) if unsure is None else unsure
        pairs = likeliest(self._scores, self._partners, looking, self._tried)
        self._tried |= set(pairs)
        return pairs


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair of so many scans, source and target."""
    return [(source, target) for source in range(count) for target in range(source + 1, count)]


def likeliest(scores: Array, partners: int, scans: Sequence[int], tried: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """For each of some scans its so many likeliest partners among those not tried, as pairs in order.

    Args:
        scores: (N, N), symmetric.
        partners: how many.
        scans: which scans look for partners.
        tried: pairs, the smaller number first.
    """
    pairs = set()
    for scan in scans:
        order = np.argsort(-scores[scan], kind="stable").tolist()
        fresh = [tuple(sorted((scan, other))) for other in order if other != scan]
        pairs |= set([pair for pair in fresh if pair not in tried][:partners])
    return sorted((int(one), int(other)) for one, other in pairs)


def likeliness(points: Sequence[Array], features: Sequence[NDArray[np.float32]], spacing: float) -> Array:
    """How likely each two of N scans show one place, (N, N), symmetric: their :func:`vote`.

    Args:
        points: N arrays (M, 3).
        features: of the points, N arrays (M, K).
        spacing: of the points.
    """
    chosen = [np.linspace(0, len(rows) - 1, min(VOTERS, len(rows))).astype(np.int64) for rows in points]
    points = [rows[some] for rows, some in zip(points, chosen, strict=True)]
    directions = [unit(rows[some]) for rows, some in zip(features, chosen, strict=True)]
    reach = AGREE * spacing * max(1.0, np.sqrt(max(len(rows) for rows in features) / VOTERS))
    scores = np.zeros((len(points), len(points)))
    for one, other in all_pairs(len(points)):
        value = vote(points[one], directions[one], points[other], directions[other], reach)
        scores[one, other] = scores[other, one] = value
    return scores


def vote(one: Array, one_features: Array, other: Array, other_features: Array, reach: float) -> float:
    """How many matches of two scans agree with the one that most agree with.

    Matches are mutual nearest neighbours by features; two agree where their distance is the same in both scans.
    """
    likeness = one_features @ other_features.T
    best, back = likeness.argmax(1), likeness.argmax(0)
    mine = np.flatnonzero(back[best] == np.arange(len(best)))
    if len(mine) < 3:
        return 0.0
    apart = [np.linalg.norm(p[:, None] - p, axis=-1) for p in (one[mine], other[best[mine]])]
    agree = (np.abs(apart[0] - apart[1]) < reach) & (np.minimum(*apart) > reach)
    # agreement of the second order: how many agree with both, which chance seldom brings about
    both = agree * (agree.astype(np.float32) @ agree.astype(np.float32))
    return float(both.sum(1).max())


def unit(features: NDArray[np.float32]) -> Array:
    """Features (M, K) less their mean, of length one."""
    centred = features.astype(np.float64) - features.mean(0)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-12))
