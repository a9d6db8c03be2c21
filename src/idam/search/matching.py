"""How alike the points of two clouds are: the similarity matrix, the matches it makes, what it says of a transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.pyramid import PairLevel
from idam.clouds.surfaces import SAME_SURFACE, TOUCHING
from idam.describe.invariant import Descriptor
from idam.describe.products import product
from idam.rigid import Array, Rows

__all__ = ["FeatureMatches", "Matching", "mutual_matches"]

Scores = NDArray[np.float32]

MATCHES = 600
"""Matches at most, the likeliest: the compatibility matrix grows with their square."""
TOLERANCE = 1.5
"""Spacings by which distances between two matches may differ, and by which a match may miss."""
REACH = 1.7
"""Tolerances within which a refined transform counts as bringing a match together."""
FEW = 50
"""Matches that must be there before a share of them says much."""
SOME = 250
"""Points that tell which of many transforms to look into."""
AGAINST, FOR = -2.0, 4.0
"""Least and most that one pair of points says against or for a transform, as a logarithm of likelihoods."""


@dataclass(frozen=True)
class FeatureMatches:
    """Points (M, 3) of the source and of the target whose features are alike, and how far right ones may miss."""

    source: Array
    target: Array
    tolerance: float

    def weights(self, transformation: Array) -> Array:
        """How well a transform (4, 4) brings each match together, (M,): 1 at no distance, 0 from its reach on."""
        miss = np.linalg.norm(rigid.apply(transformation, self.source) - self.target, axis=1)
        return np.asarray((1 - (miss / (REACH * self.tolerance)) ** 2).clip(0))

    def support(self, transformation: Array) -> float:
        """Share of the matches that a transform (4, 4) brings together, in [0, 1]: low where there are few of them."""
        return float((self.weights(transformation) > 0).sum() / (len(self.source) + FEW))


@dataclass(frozen=True)
class Matching:
    """What the features say of two clouds of N and P points at one resolution.

    Attributes:
        clouds: the clouds.
        score: pair scores before the softmax, (N, P).
        row: logarithm of the sum of exponentials of each row, (N,).
        column: likewise of each column, (P,).
        matches: the mutual matches.
    """

    clouds: PairLevel
    score: Scores
    row: Scores
    column: Scores
    matches: FeatureMatches

    @classmethod
    def of(cls, descriptor: Descriptor, clouds: PairLevel) -> Matching:
        """By the features of a descriptor: their inner products, over the root of their length."""
        source, target = clouds.features(descriptor)
        score = product(source, target.T) / np.float32(source.shape[1] ** 0.5)
        row, column = _log_sums(score)
        i, j = mutual_matches(score, row, column)
        matches = FeatureMatches(clouds.source[i], clouds.target[j], TOLERANCE * clouds.spacing)
        return cls(clouds, score, row, column, matches)

    def likelihood(self, transformation: Array) -> float:
        """How much likelier the similarity matrix makes what a transform (4, 4) lays together than chance does.

        A sum over the source points that the transform lays on the target, of log S(i, j) over its value were all
        points alike, by row or by column, whichever is less; over the number of points of the smaller cloud. Points
        like all others say nothing; those that lie on others unlike them speak against the transform.
        """
        return float(self._speaks(*self.clouds.surfaces.alike(transformation)).sum() / min(self.score.shape))

    def likelihoods(self, transformations: Array) -> tuple[Array, Array]:
        """The :meth:`likelihood` of each of the transforms (S, 4, 4), by some of the points, (S,); and the share laid.

        That is the share of these source points that it lays on the target, (S,).
        """
        source, target = self.clouds.surfaces.source, self.clouds.surfaces.target
        some = np.arange(0, len(source.points), len(source.points) // SOME + 1)
        moved = rigid.apply(transformations, source.points[some])
        distance, nearest = target.nearest(moved.reshape(-1, 3))
        distance, nearest = distance.reshape(moved.shape[:2]), nearest.reshape(moved.shape[:2])
        normals = source.normals[some] @ transformations[:, :3, :3].swapaxes(1, 2)
        cosine = np.einsum("smd,smd->sm", normals, target.normals[nearest])
        on = (distance <= TOUCHING * self.clouds.spacing) & (np.abs(cosine) >= SAME_SURFACE)
        speaks = np.where(on, self._speaks(some[None], nearest), 0.0)
        return speaks.sum(1) * len(source.points) / (len(some) * min(self.score.shape)), on.mean(1)

    def _speaks(self, rows: Rows, columns: Rows) -> Array:
        """What pairs of a source and a target point, by their rows, say for a transform that lays them together."""
        score = self.score[rows, columns].astype(np.float64)
        by_row = score - self.row[rows] + np.log(self.score.shape[1])
        by_column = score - self.column[columns] + np.log(self.score.shape[0])
        return np.asarray(np.minimum(by_row, by_column).clip(AGAINST, FOR))


def mutual_matches(score: Scores, row: Scores, column: Scores) -> tuple[Rows, Rows]:
    """Rows and columns (M,) of scores (N, P) where each is among the other's two best, the likeliest first.

    The likelihood of a match is its share of the softmax of its row, the similarity matrix (equation 3), times that of
    the softmax of its column: a point that is like many others is a poor match to all of them.

    Args:
        score: (N, P).
        row: logarithms of the sums of exponentials of the rows, (N,).
        column: likewise of the columns, (P,).
    """
    i, j = np.divmod(np.flatnonzero(_among_best(score, 1) & _among_best(score, 0)), score.shape[1])
    likelihood = 2 * score[i, j] - row[i] - column[j]
    order = np.argsort(-likelihood, kind="stable")[:MATCHES]
    return i[order], j[order]


def _among_best(score: Scores, axis: int) -> NDArray[np.bool_]:
    """Which scores (N, P) are one of the two best along an axis."""
    best, left = np.zeros(score.size, bool), score.copy()
    for _ in range(min(2, score.shape[axis])):
        # argmax along columns takes ten times as long
        at = np.flatnonzero(left == left.max(axis, keepdims=True))
        line = at // score.shape[1] if axis == 1 else at % score.shape[1]
        at = at[np.unique(line, return_index=True)[1]]
        best[at] = True
        left.reshape(-1)[at] = -np.inf
    return best.reshape(score.shape)


def _log_sums(score: Scores) -> tuple[Scores, Scores]:
    """The logarithms of the sums of exponentials of scores (N, P), by row (N,) and by column (P,).

    Scores are inner products of vectors of one length: their exponentials neither overflow nor vanish.
    """
    exponential = np.exp(score)
    return np.log(exponential.sum(1)), np.log(exponential.sum(0))
