"""Symmetric ICP: both clouds' surfaces laid on each other, though they have no point in common.

After Rusinkiewicz, "A Symmetric Objective Function for ICP", ACM Transactions on Graphics 38, 2019: of two points p and
q of one curved surface, with normals n and m, (p - q) . (n + m) is next to nothing wherever on it they lie. Points that
have no copy in the other cloud are not drawn to the nearest one, as point to point, and a point may lie off the other's
tangent plane as the surface curves, as point to plane does not allow. What slides along itself, as a table's top does,
rests where points of both lie evenly, for a small part of their whole distance pulls, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from idam.align import Refinable

__all__ = ["symmetric_icp"]

Points = NDArray[np.float64]

OFF = 0.4
"""Share of the reach that two points lie off a common surface by where they have lost three quarters of their pull."""
PULL = 0.05
"""Share of the pull of the whole distance of two points, beside that along their normals."""
DAMPING = 1e-4
"""Pull towards no motion, as of so many pairs, so that there is a step where next to nothing pulls."""
STILL = 1e-5
"""Length of the step, in radians and working units, from which on it is done."""


def symmetric_icp(
    source: Refinable, target: Refinable, start: Points, distance: float, iterations: int
) -> tuple[Points, NDArray[np.float64]]:
    """Improve a transform (4, 4) that is nearly right. Each point of either cloud is paired with the other's nearest.

    Args:
        source: in working coordinates.
        target: likewise.
        start: where to begin.
        distance: points further apart do not pull on each other, nearer ones the more.
        iterations: at most.

    Returns:
        The transform (4, 4), and the information matrix (6, 6), rotation before translation.
    """
    transformation, information = start, np.zeros((6, 6))
    for _ in range(iterations):
        step, information = _step(source, target, transformation, distance)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        moved = np.eye(4)
        moved[:3, :3] = turn @ transformation[:3, :3]
        moved[:3, 3] = turn @ transformation[:3, 3] + step[3:]
        transformation = moved
        if np.abs(step).max() < STILL:
            break
    return transformation, information


def _step(source: Refinable, target: Refinable, transformation: Points, reach: float) -> tuple[Points, Points]:
    """One step of Gauss and Newton, a rotation vector and a translation, (6,), and the matrix (6, 6) it solves."""
    rotation, translation = transformation[:3, :3], transformation[:3, 3]
    moved, normals = source.points @ rotation.T + translation, source.normals @ rotation.T
    to_target, row = target.search.query(moved, distance_upper_bound=reach)
    to_source, column = source.search.query((target.points - translation) @ rotation, distance_upper_bound=reach)
    mine, theirs = np.flatnonzero(np.isfinite(to_target)), np.flatnonzero(np.isfinite(to_source))
    i, j = np.concatenate([mine, column[theirs]]), np.concatenate([row[mine], theirs])
    distance = np.concatenate([to_target[mine], to_source[theirs]])
    p, n, m = moved[i], normals[i], target.normals[j]
    cosine = (n * m).sum(1)
    normal = n * np.copysign(1.0, cosine)[:, None] + m
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-9)
    # along the normal, and along each axis
    directions = np.concatenate([normal[None], np.broadcast_to(np.eye(3)[:, None], (3, len(p), 3))])
    residual = ((p - target.points[j]) * directions).sum(-1)
    weight = (1 - (distance / reach) ** 2) * (1 + (residual[0] / (OFF * reach)) ** 2) ** -2.0 * cosine**2
    gradient = np.concatenate([np.cross(p, directions), directions], -1).reshape(-1, 6)
    weighted = gradient * (np.array([1.0, PULL, PULL, PULL])[:, None] * weight).reshape(-1, 1)
    information = gradient.T @ weighted
    return np.linalg.solve(information + DAMPING * np.eye(6), -(weighted.T @ residual.ravel())), information
