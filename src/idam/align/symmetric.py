"""Symmetric ICP: both clouds' surfaces laid on each other, though they have no point in common.

After Rusinkiewicz, "A Symmetric Objective Function for ICP", ACM Transactions on Graphics 38, 2019: of two points p and
q of one curved surface, with normals n and m, (p - q) . (n + m) is next to nothing wherever on it they lie. Points that
have no copy in the other cloud are not drawn to the nearest one, as point to point, and a point may lie off the other's
tangent plane as the surface curves, as point to plane does not allow. What slides along itself, as a table's top does,
rests where points of both lie evenly, for a small part of their whole distance pulls, too.
"""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surfaces
from idam.describe.products import gram
from idam.rigid import Array

__all__ = ["symmetric_icp"]

OFF = 0.4
"""Share of the reach that two points lie off a common surface by where they have lost three quarters of their pull."""
PULL = 0.05
"""Share of the pull of the whole distance of two points, beside that along their normals."""
DAMPING = 1e-4
"""Pull towards no motion, as of so many pairs, so that there is a step where next to nothing pulls."""
STILL = 1e-5
"""Length of the step, in radians and working units, from which on it is done."""


def symmetric_icp(surfaces: Surfaces, start: Array, distance: float, iterations: int) -> Array:
    """Improve a transform (4, 4) that is nearly right. Each point of either cloud is paired with the other's nearest.

    Args:
        surfaces: in working coordinates.
        start: where to begin.
        distance: points further apart do not pull on each other, nearer ones the more.
        iterations: at most.

    Returns:
        The transform (4, 4).
    """
    transformation = start
    for _ in range(iterations):
        step = _step(surfaces, transformation, distance)
        turn = rigid.rotation_exp(step[:3])
        transformation = rigid.transform(turn @ transformation[:3, :3], turn @ transformation[:3, 3] + step[3:])
        if np.abs(step).max() < STILL:
            break
    return transformation


def _step(surfaces: Surfaces, transformation: Array, reach: float) -> Array:
    """One step of Gauss and Newton, a rotation vector and a translation, (6,), to apply after the transform."""
    spacings = reach / surfaces.spacing
    to_target, mine, row = surfaces.touching(transformation, spacings)
    to_source, theirs, column = surfaces.swapped.touching(rigid.inverse(transformation), spacings)
    i, j = np.concatenate([mine, column]), np.concatenate([row, theirs])
    distance = np.concatenate([to_target, to_source])
    p = rigid.apply(transformation, surfaces.source.points[i])
    n, m = surfaces.source.normals[i] @ transformation[:3, :3].T, surfaces.target.normals[j]
    cosine = (n * m).sum(1)
    normal = n * np.copysign(1.0, cosine)[:, None] + m
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-9)
    # along the normal, and along each axis
    directions = np.concatenate([normal[None], np.broadcast_to(np.eye(3)[:, None], (3, len(p), 3))])
    residual = ((p - surfaces.target.points[j]) * directions).sum(-1)
    weight = (1 - (distance / reach) ** 2) * (1 + (residual[0] / (OFF * reach)) ** 2) ** -2.0 * cosine**2
    gradient = np.concatenate([np.cross(p, directions), directions], -1).reshape(-1, 6)
    weighted = gradient * (np.array([1.0, PULL, PULL, PULL])[:, None] * weight).reshape(-1, 1)
    system = gram(weighted, np.concatenate([gradient, residual.reshape(-1, 1)], 1))
    return np.asarray(np.linalg.solve(system[:, :6] + DAMPING * np.eye(6), -system[:, 6]))
