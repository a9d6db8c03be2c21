"""What one scan shows and the other does not lies past where the other ends.

A transform that slides a surface along itself, or turns a symmetric object over, brings much of both together, but
leaves points of one cloud alone amid those of the other: the other scan ought to have seen them. Where scans end, they
end at a border, and a plane is the simplest one: a half-space crops the clouds of the paper's protocol, and what a
scanner sees of an object ends much the same way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces
from idam.rigid import Array

__all__ = ["mixing"]

ALONE = 2.0
"""Spacings to the nearest point of the other cloud from which on a point is one that the other does not show."""
STEPS = 10
"""Of Newton's method, which has converged by then."""
SHRINK = 0.002
"""Pull on the plane's normal per point, so that clouds which a plane divides do not send it to infinity."""
SHARP = 3.0
"""By how much coordinates in working units are multiplied: about the slope that a border has."""


def mixing(surfaces: Surfaces, transformation: Array) -> float:
    """How far what only one cloud shows is mixed with the other cloud, under a transform (4, 4); 0 for not at all.

    For either cloud, a plane tells its points from those of the other that lie on none of them, as well as a plane can
    (a logistic regression); the sum of both cross-entropies, in nats a point, is the answer. Swapping changes nothing.
    """
    source, target = surfaces.source, surfaces.target
    moved, back = rigid.apply(transformation, source.points), rigid.apply(rigid.inverse(transformation), target.points)
    reach = ALONE * surfaces.spacing
    return _untold(target.points, moved[_alone(moved, target, reach)]) + _untold(
        source.points, back[_alone(back, source, reach)]
    )


def _alone(points: Array, other: Surface, reach: float) -> NDArray[np.bool_]:
    """Which points (N, 3) have none of the other cloud's within reach."""
    alone: NDArray[np.bool_] = other.nearest(points)[0] > reach
    return alone


def _untold(cloud: Array, others: Array) -> float:
    """Cross-entropy per point of telling others (M, 3) from a cloud (N, 3) by a plane."""
    if len(others) == 0:
        return 0.0
    points = np.concatenate([cloud, others])
    inputs = np.concatenate([SHARP * points, np.ones((len(points), 1))], 1)
    labels = np.arange(len(points)) >= len(cloud)
    pull = SHRINK * len(points) * np.array([1.0, 1.0, 1.0, 1e-6])
    plane = np.zeros(4)
    for _ in range(STEPS):
        chance = _logistic(inputs @ plane)
        slope = (inputs * (chance * (1 - chance))[:, None]).T @ inputs + np.diag(pull)
        plane -= np.linalg.solve(slope, inputs.T @ (chance - labels) + pull * plane)
    chance = _logistic(inputs @ plane)
    return float(-np.log(np.where(labels, chance, 1 - chance)).mean())


def _logistic(x: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-x.clip(-7, 7))))
