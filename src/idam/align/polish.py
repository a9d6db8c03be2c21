"""The last stage: a nearly right transform made as precise as the points allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from idam import rigid
from idam.align.methods import copies
from idam.align.patches import Dense, Pairs, patch_size
from idam.clouds.surfaces import Surface, Surfaces
from idam.clouds.voxels import downsample
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
ALONG, SHARE = 0.998, 0.1
"""Coordinate of normals from which on a surface lies along the grid, and the share of them from which on it matters:
0.6 % of normals of all directions lie so near to an axis."""
TURN = rigid.rotation_exp(np.array([0.37, 0.59, 0.83]))
"""Rotation of a grid whose faces lie along nothing that is built."""
VOXEL = 1.3
"""Side of its voxels, in spacings of the thinned points: as of the grid that thinned them."""
SHIFT = 0.3
"""Robust standard deviations of the residuals by which the source is moved to see how patches follow: of 0.1 and 0.3
the second gives steadier shares, 0.65 to 0.95."""
RESPONSES = 0.4, 1.0
"""Bounds of these shares."""
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
        surfaces = _off_the_grid(surfaces, points)
        return _settled(lambda at: Pairs.of_points(surfaces, at), start, surfaces.spacing)
    source, target = (Dense.of(cloud) for cloud in points)
    step = max(1, size // EACH, math.ceil(len(source.points) / MOST))
    # a point that lies off the surface would hold both means back: they follow the place that they lie around
    places = source.patches(source.points[::step], size)[0].centres
    patches, _, _ = source.patches(places, size)

    def pairs_of(at: Array) -> Pairs:
        return Pairs.of_patches(patches, places, target, at, size)

    transformation, pairs = _settled(pairs_of, start, surfaces.spacing)
    return transformation, replace(pairs, response=_response(pairs_of, transformation, pairs))


def _off_the_grid(surfaces: Surfaces, points: tuple[Array, Array]) -> Surfaces:
    """The surfaces, or thinned anew by a turned grid where a good part of them lies along the axes.

    Where a wall lies in the faces of voxels, the few points that noise takes across give means that weigh as much as
    those of the rest: with noise of 0.0005 and 10^5 points the answer is off by 0.0003 rather than 0.00003.

    Args:
        surfaces: thinned by a grid along the axes.
        points: of both, not thinned.
    """
    both = surfaces.source, surfaces.target
    if all((np.abs(surface.normals) > ALONG).any(1).mean() < SHARE for surface in both):
        return surfaces
    size = VOXEL * surfaces.spacing
    source, target = (
        surface if len(cloud) <= len(surface.points) else Surface.of(downsample(cloud @ TURN, size) @ TURN.T)
        for cloud, surface in zip(points, both, strict=True)
    )
    return Surfaces(source, target, surfaces.spacing)


def _response(pairs_of: Callable[[Array], Pairs], transformation: Array, pairs: Pairs) -> float:
    """What the pull of the pairs changes by when the transform (4, 4) does, as a share of what it would if they stayed.

    Of patches a part of the noise wide, the mean follows the place: where a shift of the source takes it, other points
    of the target are nearest.
    """
    if len(pairs.points) < FEWEST:
        return 1.0
    gradient = pairs.gradients(pairs.normals)
    fixed = np.einsum("ci,c,ci->i", gradient, pairs.weights, gradient)
    step = 1 / np.sqrt(fixed + 1e-9)  # all motions alike
    along = gradient @ step
    step *= SHIFT * pairs.scale / np.sqrt(np.mean(along**2))
    moved = pairs_of(transformation @ rigid.exp(step))
    expected = step @ (gradient.T @ (pairs.weights * (gradient @ step))) * pairs.slope
    change = step @ (_pull(moved) - _pull(pairs))
    return float(np.clip(change / expected, *RESPONSES))


def _pull(pairs: Pairs) -> Array:
    """The weighted sum of the residuals' gradients, (6,)."""
    return np.asarray(pairs.gradients(pairs.normals).T @ (pairs.weights * pairs.residuals))


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
