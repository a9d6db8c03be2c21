"""Fine alignment of few points, which two scans of one surface need not share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from idam.refine import Refinable, refine

__all__ = ["FEW_POINTS", "align_few", "symmetric_icp"]

Points = NDArray[np.float64]

FEW_POINTS = 1024
"""Points of the larger cloud up to which both count as sparse."""
COPIES = 0.75
"""Median distance of points that lie on each other, in spacings, below which they are copies of the same points."""
TOUCHING = 1.5
"""Spacings within which points lie on each other."""
REACH = 2.5, 1.7
"""Spacings within which points pull on each other, at first and at last."""
OFF = 0.7
"""Spacings off the surface at which a pair has lost three quarters of its pull."""
ITERATIONS = 12
"""With each reach, at most."""
DAMPING = 1e-4
"""Pull towards no motion, as of so many pairs: what the surface leaves free, as the slide of a plane, stays."""
STILL = 1e-5
"""Length of the step, in radians and working units, from which on it is done."""


def align_few(source: Refinable, target: Refinable, start: Points, spacing: float) -> Points:
    """Improve a transform (4, 4) of sparse clouds that is nearly right.

    Where points turn out to be copies of the other cloud's, as in the paper's protocol, they have the last word; scans
    of one surface have no point in common, and only their surfaces are laid on each other.

    Args:
        source: in working coordinates.
        target: likewise.
        start: where to begin.
        spacing: of the points.

    Returns:
        The transform (4, 4); the start, where nothing lies near.
    """
    transformation = symmetric_icp(source, target, start, spacing)
    moved = source.points @ transformation[:3, :3].T + transformation[:3, 3]
    distance = target.search.query(moved, distance_upper_bound=TOUCHING * spacing)[0]
    touching = distance[np.isfinite(distance)]
    if len(touching) and np.median(touching) < COPIES * spacing:
        transformation, _ = refine(source, target, transformation, spacing, "point", iterations=100)
    return transformation


def symmetric_icp(source: Refinable, target: Refinable, start: Points, spacing: float) -> Points:
    """Improve a transform (4, 4) that is nearly right, by a symmetric distance of the surfaces.

    Of two points p and q of one curved surface, with normals n and m, (p - q) . (n + m) is next to nothing wherever on
    it they lie (Rusinkiewicz, "A Symmetric Objective Function for ICP", ACM Transactions on Graphics 38, 2019): points
    that have no copy in the other cloud are not drawn to the nearest one. Each point of either cloud is paired with
    the nearest of the other.

    Args and result as of :func:`align_few`.
    """
    transformation = start
    for reach in REACH:
        for _ in range(ITERATIONS):
            step = _step(source, target, transformation, reach * spacing, OFF * spacing)
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            moved = np.eye(4)
            moved[:3, :3] = turn @ transformation[:3, :3]
            moved[:3, 3] = turn @ transformation[:3, 3] + step[3:]
            transformation = moved
            if np.abs(step).max() < STILL:
                break
    return transformation


def _step(source: Refinable, target: Refinable, transformation: Points, reach: float, off: float) -> Points:
    """One step of Gauss and Newton, a rotation vector and a translation, (6,)."""
    rotation, translation = transformation[:3, :3], transformation[:3, 3]
    moved, normals = source.points @ rotation.T + translation, source.normals @ rotation.T
    to_target, row = target.search.query(moved, distance_upper_bound=reach)
    to_source, column = source.search.query((target.points - translation) @ rotation, distance_upper_bound=reach)
    mine, theirs = np.flatnonzero(np.isfinite(to_target)), np.flatnonzero(np.isfinite(to_source))
    i, j = np.concatenate([mine, column[theirs]]), np.concatenate([row[mine], theirs])
    distance = np.concatenate([to_target[mine], to_source[theirs]])
    p, offset = moved[i], moved[i] - target.points[j]
    n, m = normals[i], target.normals[j]
    cosine = (n * m).sum(1)
    normal = n * np.copysign(1.0, cosine)[:, None] + m
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-9)
    residual = (offset * normal).sum(1)
    weight = (1 - (distance / reach) ** 2) * (1 + (residual / off) ** 2) ** -2.0 * cosine**2
    gradient = np.concatenate([np.cross(p, normal), normal], 1)
    weighted = gradient * weight[:, None]
    step: Points = np.linalg.solve(gradient.T @ weighted + DAMPING * np.eye(6), -(weighted.T @ residual))
    return step
