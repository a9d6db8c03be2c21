"""Poses slid along the surface that two clouds share.

A vase turned about its axis looks the same, and so does a door slid along itself: there, where an alignment stops is
chance. The motions that leave a surface on itself are its slippable ones (Gelfand and Guibas, "Shape Segmentation Using
Local Slippage Analysis", SGP 2004).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from idam.align import Surfaces, reaches
from idam.search.matching import Matching
from idam.search.ranking import Answer, distinct, improve, likeliest

__all__ = ["slid", "slips"]

Points = NDArray[np.float64]

NEARLY = 0.2
"""Mean square, per mean square of a motion, of what it moves along the normals, below which an answer is slid: that
much, edges and other small things still hold it."""
SLID = 8
"""Slid answers, the likeliest, that are refined."""
FARTHEST = 0.5
"""Working units that a surface is slid at most; what turns is turned all the way round."""


def slid(
    answers: list[Answer], matching: Matching, within: Callable[[Iterable[Points]], list[Answer]], method: str
) -> list[Answer]:
    """The answers, and before them the first one slid along the common surface, where that has a higher score.

    Args:
        answers: the best first, refined and scored on the matched clouds.
        matching: of these clouds.
        within: leaves out transforms that turn too far, and makes answers of the others.
        method: of refinement.
    """
    starts = within(slips(matching.clouds.surfaces, answers[0].transformation, NEARLY))
    tried = improve(likeliest(starts, matching, SLID), matching, reaches(method)[1], method)
    best = max([answers[0], *tried], key=lambda answer: answer.score)
    return distinct([best, *answers])


def slips(surfaces: Surfaces, transformation: Points, slippable: float) -> Points:
    """The transform (4, 4), carried on along each motion that leaves the common surface on itself: (S, 4, 4).

    Args:
        surfaces: the clouds.
        transformation: lays the source on the target.
        slippable: mean square, per mean square of a motion, of what it moves along the normals at most.
    """
    distance, row = surfaces.to_target(transformation)
    on = np.flatnonzero(np.isfinite(distance))
    if len(on) < 6:
        return np.empty((0, 4, 4))
    points = surfaces.source.points[on] @ transformation[:3, :3].T + transformation[:3, 3]
    normals = surfaces.target.normals[row[on]]
    centre = points.mean(0)
    radius = float(np.sqrt(((points - centre) ** 2).sum(1).mean()))
    along = np.concatenate([np.cross((points - centre) / radius, normals), normals], 1)
    share, motions = np.linalg.eigh(along.T @ along / len(on))
    found = [np.empty((0, 4, 4))]
    for motion in motions.T[share < slippable]:
        turn, shift = motion[:3] / radius, motion[3:]
        speed = float(np.linalg.norm(turn))
        far = np.pi / speed if speed > 1.0 else FARTHEST
        steps = np.arange(surfaces.spacing, max(far, 2 * surfaces.spacing), surfaces.spacing)
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), turn)
        twist[:3, 3] = shift - np.cross(turn, centre)
        found.append(expm(np.concatenate([-steps, steps])[:, None, None] * twist) @ transformation)
    return np.concatenate(found)
