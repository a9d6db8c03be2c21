"""Candidate transforms from every two matches whose points and normals lie to each other alike.

Two oriented points are described by their distance, the angles between both normals and the line from one to the other,
and the turn about it (Drost et al., "Model Globally, Match Locally: Efficient and Robust 3D Object Recognition", CVPR
2010). A rigid motion keeps these, and one such pair fixes it. So few wrong matches agree in all of them by chance that
ten right ones among six hundred show, which counting by distances alone (:mod:`idam.search.consensus`) misses; but each
two matches have to be tried, and most of what they give is wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces
from idam.rigid import Array, Rows
from idam.search.consensus import brought_together, kabsch_rotations, solved_anew
from idam.search.matching import FeatureMatches
from idam.search.ranking import distinct

__all__ = ["point_pair_transforms"]

ANGLE = 0.2
"""By how much the cosines of two pairs of oriented points may differ. With 0.3 twice as many agree by chance, with 0.1
the normals of real scans do not agree often enough."""
APART = 2.0
"""Tolerances that two points must lie apart: the line between nearer ones says little."""
PAIRS = 20_000
"""Pairs of matches at most that are tried; where more agree, every second, third... of them."""
KEPT = 500
"""Different transforms that are solved anew from the matches that they bring together. The right one was the 28th to
the 290th for a street, a room and two parts, where 5 to 12 matches are right."""
LOOSE = 1.5
"""Tolerances within which the transform of one pair brings a match together."""
ROUNDS = 2
"""Times a transform is solved anew."""
LINE = 1.5
"""Weight of the line between two points, next to each of their normals."""
LEVEL = 0.15
"""Second singular value of the directions' covariance from which on they fix a rotation: parallel ones do not."""
SIGNS = (1, 1), (1, -1), (-1, 1), (-1, -1)
"""Of the normals of two points, which have no side."""
AT_ONCE = 2000
"""Transforms whose matches are counted together."""


class _PointPairs(NamedTuple):
    """Two oriented points each: the middle (Q, 3), the distance (Q,), the unit line and both normals (Q, 3)."""

    middle: Array
    length: Array
    line: Array
    first: Array
    second: Array

    @classmethod
    def of(cls, points: Array, surface: Surface, i: Rows, j: Rows) -> _PointPairs:
        """Of points (M, 3) of a surface, by the rows (Q,) of each two."""
        normals = surface.normals[surface.nearest(points)[1]]
        gap = points[j] - points[i]
        length = np.linalg.norm(gap, axis=1)
        return cls((points[i] + points[j]) / 2, length, gap / length[:, None], normals[i], normals[j])

    def at(self, rows: Rows) -> _PointPairs:
        """Some of them."""
        return _PointPairs(*(field[rows] for field in self))

    def turned(self, first: int, second: int) -> _PointPairs:
        """With the normals times these signs."""
        return self._replace(first=first * self.first, second=second * self.second)

    def angles(self) -> Array:
        """Cosines of the normals with the line and with each other, and the triple product of all three, (4, Q)."""
        dots = [(self.first, self.line), (self.second, self.line), (self.first, self.second)]
        triple = np.cross(self.first, self.line), self.second
        return np.array([np.einsum("qd,qd->q", one, other) for one, other in [*dots, triple]])

    def directions(self) -> Array:
        """Three directions that a motion turns, (Q, 3, 3), by rows."""
        return np.stack([LINE * self.line, self.first, self.second], 1)


def point_pair_transforms(matches: FeatureMatches, surfaces: Surfaces) -> Array:
    """Transforms (S, 4, 4) on which two matches or more agree, those that bring most matches together first.

    Args:
        matches: of which some are right.
        surfaces: that their points are of.
    """
    transforms = _transforms(*_alike(matches, surfaces))
    if len(transforms) == 0:
        return transforms
    blocks = [transforms[start : start + AT_ONCE] for start in range(0, len(transforms), AT_ONCE)]
    number = [brought_together(matches, block, LOOSE * matches.tolerance).sum(1) for block in blocks]
    transforms = transforms[np.argsort(-np.concatenate(number), kind="stable")]
    transforms = transforms[distinct(transforms, KEPT)]
    return solved_anew(matches, brought_together(matches, transforms, LOOSE * matches.tolerance), ROUNDS)


def _alike(matches: FeatureMatches, surfaces: Surfaces) -> tuple[_PointPairs, _PointPairs]:
    """Two matches each, as two points of the source and as two of the target that lie to each other alike.

    The normals of the source are tried with either sign, and come with the one that fits.
    """
    i, j = np.triu_indices(len(matches.source), 1)
    one, other = (np.linalg.norm(points[j] - points[i], axis=1) for points in (matches.source, matches.target))
    held = (np.abs(one - other) < matches.tolerance) & (np.minimum(one, other) > APART * matches.tolerance)
    i, j = i[held], j[held]
    source = _PointPairs.of(matches.source, surfaces.source, i, j)
    target = _PointPairs.of(matches.target, surfaces.target, i, j)
    known = ANGLE + 0.5 * matches.tolerance / source.length  # the direction of a short line is known less
    within = np.array([known, known, np.full(len(i), ANGLE), known])
    mine, theirs = source.angles(), target.angles()
    flips = [np.array([a, b, a * b, a * b])[:, None] for a, b in SIGNS]
    rows = [np.flatnonzero((np.abs(flip * mine - theirs) < within).all(0)) for flip in flips]
    step = sum(map(len, rows)) // PAIRS + 1
    rows = [some[::step] for some in rows]
    parts = [source.at(some).turned(*signs) for some, signs in zip(rows, SIGNS, strict=True)]
    turned = _PointPairs(*(np.concatenate(field) for field in zip(*parts, strict=True)))
    return turned, target.at(np.concatenate(rows))


def _transforms(source: _PointPairs, target: _PointPairs) -> Array:
    """The transforms (S, 4, 4) that lay each two points on their counterparts, where these fix one."""
    rotation, values = kabsch_rotations(source.directions().swapaxes(1, 2) @ target.directions())
    shift = target.middle - np.einsum("qij,qj->qi", rotation, source.middle)
    return rigid.transform(rotation, shift)[values[:, 1] > LEVEL]
