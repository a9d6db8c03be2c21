"""Poses that a pose may be mistaken for where a scene repeats, and where it may belong instead: shifted as votes say.

Bays, pillars, stalls and steps lie on each other one further, too. For a given rotation every two points of one normal
vote for the shift between them, and those with the most votes are places to look at: the right one and the repeats.
What is rare tells more: walls and floors fix a direction each with most of the points, and a few posts the third. So
those points vote whose normals the rest has least of: by their leverage in the sum of squared motions along normals.
"""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces
from idam.rigid import Array, Rows

__all__ = ["repeats"]

VOTERS = 300
"""Points of each cloud that vote, those of most leverage."""
ALIKE = 0.9
"""|cosine| of two normals from which on their points vote."""
CELL = 1.5
"""Spacings of a cell of shifts: with its neighbours' votes it reaches one and a half to either side."""
PLACES = 6
"""Shifts with the most votes that are looked at. Of 12 wrong poses of ray-cast scenes that repeat, whose rotation was
right, the right shift was among the first eight in 11."""
WEAK = 0.4
"""Share of the most votes below which a shift is not looked at."""
FLAT = 1e-3
"""Least share of the normals that a direction is taken to have: there may be none."""


def repeats(surfaces: Surfaces, transformation: Array) -> Array:
    """Poses (S, 4, 4) of a pose's rotation whose shifts have the most votes; the pose (4, 4) may be one of them."""
    rotation = transformation[:3, :3]
    mine, normals = _voters(surfaces.source)
    theirs, other = _voters(surfaces.target)
    mine, normals = mine @ rotation.T, normals @ rotation.T
    i, j = np.nonzero(np.abs(normals @ other.T) > ALIKE)
    if len(i) == 0:
        return np.empty((0, 4, 4))
    shifts = _most_voted(theirs[j] - mine[i], i, CELL * surfaces.spacing)
    return rigid.transform(np.broadcast_to(rotation, (len(shifts), 3, 3)), shifts)


def _voters(surface: Surface) -> tuple[Array, Array]:
    """The points (V, 3) of most leverage, and their normals (V, 3)."""
    normals = surface.normals
    share, axes = np.linalg.eigh(normals.T @ normals / len(normals))
    leverage = ((normals @ axes) ** 2 / np.maximum(share, FLAT)).sum(1)
    rows = np.sort(np.argsort(-leverage, kind="stable")[:VOTERS])
    return surface.points[rows], normals[rows]


def _most_voted(shifts: Array, voter: Rows, cell: float) -> Array:
    """The shifts (S, 3) that most voters (V,) have one (V, 3) near, each voter counting once a cell."""
    place = np.floor(shifts / cell).astype(np.int64)
    least = place.min(0) - 1
    size = place.max(0) - least + 2
    voters = int(voter.max()) + 1
    once = np.unique(np.ravel_multi_index(tuple((place - least).T), tuple(size)) * voters + voter)
    votes = np.bincount(once // voters, minlength=int(size.prod())).reshape(size).astype(np.float64)
    for axis in range(3):
        votes = votes + np.roll(votes, 1, axis) + np.roll(votes, -1, axis)
    chosen: list[Array] = []
    most = votes.max()
    while len(chosen) < PLACES:
        best = np.unravel_index(int(votes.argmax()), votes.shape)
        if votes[best] < WEAK * most:
            break
        chosen.append((np.array(best) + least + 0.5) * cell)
        votes[tuple(slice(max(0, at - 2), at + 3) for at in best)] = 0
    return np.array(chosen)
