"""The last stage: a nearly right transform made as precise as the points allow."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from idam import rigid
from idam.align.methods import copies
from idam.align.patches import Dense, Pairs, patch_size
from idam.clouds.surfaces import Surfaces
from idam.rigid import Array

__all__ = ["finished", "polish"]

ITERATIONS = 3
"""At most."""
STILL = 5e-6
"""Length of a step, in radians and working units, from which on it is done."""
FEWEST = 30
"""Pairs of patches below which the start stays."""
EXACT = 0.1
"""Robust standard deviation of sparse clouds' residuals, in spacings, below which their points alone are more exact
than the symmetric method: with noise of 1 % of the spacing ten times as exact, with 20 % of it less."""
EACH = 2
"""Patches that a point is in, in the mean, at most: more of them cost time and know no more."""
MOST = 10_000
"""Patches at most. They lie around points of the source, every n-th. Around means of voxels, a voxel that noise just
reaches gives a patch that holds the stray point and weighs as much as a full one: walls along the grid, with noise of
0.01 and 10^5 points, then end 0.0012 off rather than 0.0003."""
FARTHEST = 3.0
"""Spacings by which it may move the source's points (root mean square): more is not polishing, and the start stays."""


def finished(
    surfaces: Surfaces, dense: Callable[[], tuple[Array, Array]], start: Array, method: str, last: bool
) -> tuple[Array, Pairs]:
    """The transform to give, and the pairs that its precision is told by.

    Args:
        surfaces: that the transform was refined on.
        dense: makes both clouds with as many points as there are.
        start: (4, 4), as the method left it.
        method: that refined it. Copies of points, which only the symmetric one looks for, hold each other every way.
        last: whether to :func:`polish`.
    """
    if method == "symmetric" and copies(surfaces, start):
        return start, Pairs.of_points(surfaces, start).each_way()
    if method == "symmetric" and last:
        polished = _settled(lambda at: Pairs.of_points(surfaces, at), start, surfaces.spacing)
        if polished[1].scale < EXACT * surfaces.spacing:
            return polished
    if method == "symmetric" or not last:
        return start, Pairs.of_points(surfaces, start)
    return polish(surfaces, start, dense)


def polish(surfaces: Surfaces, start: Array, dense: Callable[[], tuple[Array, Array]]) -> tuple[Array, Pairs]:
    """Lay points of both surfaces on each other or, where noise goes past their spacing, means of many points.

    Args:
        surfaces: in working coordinates, thinned.
        start: (4, 4), off by less than the spacing of the surfaces' points.
        dense: makes source and target with as many of their points as there are, not thinned by voxels: the mean of a
            voxel that noise just reaches weighs as much as that of a full one, and whole walls are off by a part of the
            noise.

    Returns:
        The transform (4, 4), and the pairs under it that fixed it.
    """
    points = dense()
    size = max(patch_size(cloud, surfaces.spacing) for cloud in points)
    if size == 1:
        return _settled(lambda at: Pairs.of_points(surfaces, at), start, surfaces.spacing)
    source, target = (Dense.of(cloud) for cloud in points)
    step = max(1, size // EACH, math.ceil(len(source.points) / MOST))
    # a point that lies off the surface would hold both means back: they follow the place that they lie around
    places = source.patches(source.points[::step], size)[0].centres
    patches, _, _ = source.patches(places, size)
    return _settled(lambda at: Pairs.of_patches(patches, places, target, at, size), start, surfaces.spacing)


def _settled(pairs_of: Callable[[Array], Pairs], start: Array, spacing: float) -> tuple[Array, Pairs]:
    """Gauss and Newton from a start (4, 4) until the step is still."""
    first = pairs = pairs_of(start)
    transformation = start
    for _ in range(ITERATIONS):
        if len(pairs.points) < FEWEST:
            return start, first
        step = _step(pairs)
        transformation = transformation @ rigid.exp(step)
        pairs = pairs_of(transformation)
        if np.abs(step).max() < STILL:
            break
    moved = rigid.apply(transformation, first.points) - rigid.apply(start, first.points)
    if len(pairs.points) < FEWEST or not np.sqrt((moved**2).sum(1).mean()) <= FARTHEST * spacing:
        return start, first
    return transformation, pairs


def _step(pairs: Pairs) -> Array:
    """Of Gauss and Newton, (6,)."""
    gradient = pairs.gradients(pairs.normals)
    weighted = gradient * pairs.weights[:, None]
    # as of one pair each: where nothing holds, it stays
    # what is solved for takes the weights as they are; they fall with the residuals, and steps come out too short
    return np.linalg.solve(weighted.T @ gradient * pairs.slope + np.eye(6), -(weighted.T @ pairs.residuals))
