"""Poses that a pose may be mistaken for: slid and turned along what the clouds share, and the other way round.

In a corridor, along a road or around a vase many poses lay the common surface on itself, and where an alignment stops
is chance. The motions that leave a surface on itself are its slippable ones (Gelfand and Guibas, "Shape Segmentation
Using Local Slippage Analysis", SGP 2004). What fixes the place there, posts, boxes, doors, is a few per cent of the
points: too little to pull an alignment, but enough to vote for how far to slide it.
"""

from __future__ import annotations

import math

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces
from idam.rigid import Array

__all__ = ["held", "slides", "slippage"]

SLIPPABLE = 0.02
"""Mean square, per mean square of a motion, of what it moves along the normals, below which a pose may slide: as a
corridor's point clouds do in spite of their noise (0.002 to 0.02)."""
FARTHEST = 1.0
"""Working units that a pose is slid at most, as far as the larger cloud is wide; what turns is turned all the way."""
STEPS = 16
"""Poses either way along a motion at most."""

LENGTHS = -8, -4, 4, 8
"""Spacings that a surface is slid along itself by, to see which of its points do not stay on it."""
OFF = 1.5
"""Spacings off the surface from which on a point does not stay on it."""
GAP = 6.0
"""Spacings to the nearest point past which a slid point has left the scan, which says nothing."""
BIN = 0.006
"""Length at least by which slides are told from each other, in working units."""
MOST = 600
"""Points at most that are asked what fixes a pose: where there are more, some of them tell as well."""
HELD = 10
"""Points at least that must come to lie on each other for a pose to be slid there."""
MORE = 1.3
"""Times as many as lie on each other where the pose is. Of two roads 2.3 and 4.8 m off it is 1.4 and 2.5 where the pose
belongs; of a right one 0.4 elsewhere."""


def slippage(surfaces: Surfaces, transformation: Array) -> tuple[Array, Array, Array]:
    """The motions under which the common surface of a pose (4, 4) stays on itself, the most slippable first.

    Returns:
        For each of six motions the mean square of what it moves along the normals, per mean square of what it moves,
        (6,); the motions as twists of the target's frame about the centre, (6, 6); and the centre (3,). Nothing where
        fewer than six points lie on each other.
    """
    return _slippage(*_shared(surfaces, transformation))


def slides(surfaces: Surfaces, transformation: Array) -> Array:
    """Poses (S, 4, 4) that lay the common surface of a pose (4, 4) on itself, nearly; none where it does not slide."""
    points, normals = _shared(surfaces, transformation)
    share, motions, centre = _slippage(points, normals)
    motions = motions[share < SLIPPABLE]
    if len(motions) == 0:
        return np.empty((0, 4, 4))
    starts = np.concatenate([transformation[None], _half_turns(points) @ transformation])
    there, back = rigid.transform(np.eye(3), centre), rigid.transform(np.eye(3), -centre)
    slid = [starts[1:]]
    for motion in motions:
        speed = float(np.linalg.norm(motion[:3]))
        far = np.pi / speed if speed > 1.0 else FARTHEST
        steps = np.linspace(0, far, min(STEPS, int(far / surfaces.spacing)) + 1)[1:]
        along = there @ rigid.exp(np.concatenate([-steps, steps])[:, None] * motion) @ back
        slid.append((along[:, None] @ starts).reshape(-1, 4, 4))
    return np.concatenate(slid)


def _half_turns(points: Array) -> Array:
    """Half turns (3, 4, 4) about the principal axes of points (N, 3)."""
    centre = points.mean(0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    turns = rigid.transform(2 * axes[:, :, None] * axes[:, None, :] - np.eye(3), np.zeros(3))
    return rigid.transform(np.eye(3), centre) @ turns @ rigid.transform(np.eye(3), -centre)


def held(surfaces: Surfaces, fine: Surfaces, transformation: Array) -> Array:
    """A pose (4, 4) slid to where what fixes its place agrees; as it is where it does not slide, or is there already.

    Args:
        surfaces: that tell whether it slides.
        fine: that what fixes the place is sought on: it may be a few points.
        transformation: (4, 4).
    """
    share, motions, _ = slippage(surfaces, transformation)
    for motion in motions[share < SLIPPABLE]:
        if np.linalg.norm(motion[:3]) <= 1.0:  # the others turn
            along = motion[3:] / np.linalg.norm(motion[3:])
            transformation = rigid.transform(np.eye(3), _missing(fine, transformation, along) * along) @ transformation
    return transformation


def _missing(surfaces: Surfaces, transformation: Array, along: Array) -> float:
    """By how much to slide a pose (4, 4) along a direction (3,) of the target so that most of what fixes it agrees."""
    length = max(BIN, surfaces.spacing)
    back = transformation[:3, :3].T @ along
    mine = rigid.apply(transformation, _fixing(surfaces.source, back, length))
    theirs = _fixing(surfaces.target, along, length)
    gaps = theirs[None] - mine[:, None]
    slide = gaps @ along
    beside = (gaps**2).sum(-1) - slide**2
    row, column = np.nonzero((beside < (OFF * length) ** 2) & (np.abs(slide) < FARTHEST))
    middle = math.ceil(FARTHEST / length)
    agree = np.zeros((2 * middle + 3, len(mine)), bool)
    cell = np.rint(slide[row, column] / length).astype(np.int64) + middle
    for near in (-1, 0, 1):
        agree[cell + near + 1, row] = True
    number = agree.sum(1)
    best = int(number.argmax())
    if number[best] < max(HELD, MORE * number[middle : middle + 3].max()):
        return 0.0
    return (best - 1 - middle) * length


def _fixing(surface: Surface, along: Array, length: float) -> Array:
    """The points (F, 3) of a surface that do not stay on it when it is slid along a direction (3,)."""
    away = np.zeros(len(surface.points), np.int64)
    for far in LENGTHS:
        slid = surface.points + far * length * along
        distance, row = surface.nearest(slid)
        off = np.abs(((slid - surface.points[row]) * surface.normals[row]).sum(1))
        away += (off > OFF * length) & (distance < GAP * length)
    fixing = surface.points[away >= 2]
    return fixing[:: len(fixing) // MOST + 1]


def _shared(surfaces: Surfaces, transformation: Array) -> tuple[Array, Array]:
    """Points (C, 3) that a pose lays on the target, in its frame, and the target's normals there (C, 3)."""
    mine, theirs = surfaces.alike(transformation)
    return rigid.apply(transformation, surfaces.source.points[mine]), surfaces.target.normals[theirs]


def _slippage(points: Array, normals: Array) -> tuple[Array, Array, Array]:
    """:func:`slippage` of a surface's points and normals, (C, 3)."""
    if len(points) < 6:
        return np.empty(0), np.empty((0, 6)), np.zeros(3)
    centre = points.mean(0)
    radius = float(np.sqrt(((points - centre) ** 2).sum(1).mean()))
    along = np.concatenate([np.cross((points - centre) / radius, normals), normals], 1)
    share, motions = np.linalg.eigh(along.T @ along / len(points))
    return share, motions.T / np.array([radius, radius, radius, 1.0, 1.0, 1.0]), centre
