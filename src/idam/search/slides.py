"""Poses that a pose may be mistaken for: slid and turned along what the clouds share, and the other way round.

In a corridor, along a road or around a vase many poses lay the common surface on itself, and where an alignment stops
is chance. The motions that leave a surface on itself are its slippable ones (Gelfand and Guibas, "Shape Segmentation
Using Local Slippage Analysis", SGP 2004).
"""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surfaces
from idam.rigid import Array

__all__ = ["slides", "slippage"]

SLIPPABLE = 0.02
"""Mean square, per mean square of a motion, of what it moves along the normals, below which a pose may slide: as a
corridor's point clouds do in spite of their noise (0.002 to 0.02)."""
FARTHEST = 1.0
"""Working units that a pose is slid at most, as far as the larger cloud is wide; what turns is turned all the way."""
STEPS = 16
"""Poses either way along a motion at most."""


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
