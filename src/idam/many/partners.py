"""Which scans are likely to show the same place, by their features alone: a look at all pairs, a vote on some.

Scans are compared by one vector each first (VLAD: Jegou, Douze, Schmid, Perez, "Aggregating local descriptors into a
compact image representation", CVPR 2010), which costs next to nothing a pair. The likeliest are put to a vote of
matches. So the number of votes grows with the number of scans, not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.rigid import Array

__all__ = ["all_pairs", "likeliness", "signatures", "vote"]

Features = NDArray[np.float32]

WORDS = 128
"""Cells that features are sorted by. Of 128 pairs of 60 scans of a building that overlap by 30 % and more, the 24
likeliest partners of each scan hold 88 % with 32 cells, 92 with 64, 95 with 128, 98 with 256."""
ROUNDS = 8
"""Of k-means, that finds the cells."""
TAUGHT = 4000
"""Features that k-means sees."""
PUT_TO_VOTE = 24
"""Partners of each scan that are put to a vote."""
VOTERS = 512
"""Points of a scan that vote on whether another shows the same place: of those pairs the 4 likeliest partners of each
scan hold 56 % with 256 (1.3 ms a pair), 89 with 512 (2.8), 91 with 1024 (7.6)."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair of so many scans, the smaller number first."""
    return [(one, other) for one in range(count) for other in range(one + 1, count)]


def likeliness(points: Sequence[Array], features: Sequence[Features], spacing: float) -> Array:
    """How likely each two of N scans show one place, (N, N), symmetric: their :func:`vote`, 0 where none was taken.

    Args:
        points: N arrays (M, 3).
        features: of the points, N arrays (M, K).
        spacing: of the points.
    """
    chosen = [np.linspace(0, len(rows) - 1, min(VOTERS, len(rows))).astype(np.int64) for rows in points]
    places = [rows[some].astype(np.float32) for rows, some in zip(points, chosen, strict=True)]
    directions = [unit(rows[some] - rows.mean(0)) for rows, some in zip(features, chosen, strict=True)]
    scores = np.zeros((len(points), len(points)))
    for one, other in candidates(signatures(features)):
        value = vote(places[one], directions[one], places[other], directions[other], spacing)
        scores[one, other] = scores[other, one] = value
    return scores


def candidates(signature: Array) -> list[tuple[int, int]]:
    """The pairs to vote on, of scans by their signatures (N, D): those among either one's likeliest."""
    alike = signature @ signature.T
    np.fill_diagonal(alike, -np.inf)
    likeliest = np.argsort(-alike, axis=1, kind="stable")[:, : min(PUT_TO_VOTE, len(alike) - 1)]
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(likeliest.tolist()) for j in row})


def signatures(features: Sequence[Features]) -> Array:
    """One vector of length one for each of N scans (N, D): how its features differ from their cells' centres."""
    every = np.concatenate(features)
    centres = cells(every[:: len(every) // TAUGHT + 1])
    rows = np.zeros((len(features), *centres.shape))
    for row, own in zip(rows, features, strict=True):
        cell = nearest(own, centres)
        np.add.at(row, cell, own - centres[cell])
    return unit(unit(rows).reshape(len(rows), -1))


def cells(features: Features) -> Features:
    """Centres (W, K) of cells of features (M, K): k-means from features spread over the scans."""
    start = np.linspace(0, len(features) - 1, min(WORDS, len(features))).astype(np.int64)
    centres = features[start]
    for _ in range(ROUNDS):
        cell = nearest(features, centres)
        number = np.bincount(cell, minlength=len(centres))[:, None]
        total = np.zeros_like(centres)
        np.add.at(total, cell, features)
        centres = np.where(number > 0, total / np.maximum(number, 1), centres).astype(np.float32)
    return centres


def nearest(features: Features, centres: Features) -> NDArray[np.int64]:
    """The row (M,) of the centre nearest to each feature."""
    return np.asarray(((centres**2).sum(1) - 2 * features @ centres.T).argmin(1))


def vote(
    one: NDArray[Any], one_features: NDArray[Any], other: NDArray[Any], other_features: NDArray[Any], reach: float
) -> float:
    """How many matches of two scans agree with the one that most agree with.

    Matches are mutual nearest neighbours by features; two agree where their distance is the same in both scans, to
    within ``reach``.
    """
    likeness = one_features @ other_features.T
    best, back = likeness.argmax(1), likeness.argmax(0)
    mine = np.flatnonzero(back[best] == np.arange(len(best)))
    if len(mine) < 3:
        return 0.0
    first, second = (np.linalg.norm(p[:, None] - p, axis=-1) for p in (one[mine], other[best[mine]]))
    agree = ((np.abs(first - second) < reach) & (np.minimum(first, second) > reach)).astype(np.float32)
    # agreement of the second order: how many agree with both, which chance seldom brings about
    both = agree * (agree @ agree)
    return float(both.sum(1).max())


def unit(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows (..., K) of length one, or zero."""
    scaled: NDArray[Any] = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)
    return scaled
