"""How much of two clouds a transform lays on each other, and how exactly."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.clouds.surfaces import TOUCHING, Surfaces
from idam.rigid import Array

__all__ = ["exactness", "shares"]


def shares(surfaces: Surfaces, transformation: Array) -> tuple[float, float]:
    """The shares of the source's and of the target's points that lie on the other cloud, in [0, 1].

    A point lies on the nearest one of the other cloud, where they touch and their normals agree.
    """
    mine, _ = surfaces.alike(transformation)
    theirs, _ = surfaces.swapped.alike(rigid.inverse(transformation))
    return len(mine) / len(surfaces.source.points), len(theirs) / len(surfaces.target.points)


def exactness(surfaces: Surfaces, transformation: Array, reach: float) -> tuple[float, float]:
    """How exactly finer clouds lie on each other where coarser ones touch, under a transform (4, 4).

    What only seems to touch at a coarse resolution comes apart at a fine one.

    Args:
        surfaces: the finer clouds.
        transformation: (4, 4), refined on them.
        reach: distance within which the coarser clouds touch, in working units.

    Returns:
        The share of the points within reach that touch on the finer clouds too, in [0, 1]; and the median distance of
        points within reach from the other cloud's tangent plane, as a share of the reach. 0 and 1 where nothing is
        within reach.
    """
    spacings = reach / surfaces.spacing
    ways = (surfaces, transformation), (surfaces.swapped, rigid.inverse(transformation))
    within, off = [np.empty(0)], [np.empty(0)]
    for pair, way in ways:
        distance, mine, theirs = pair.touching(way, spacings)
        gap = rigid.apply(way, pair.source.points[mine]) - pair.target.points[theirs]
        within.append(distance)
        off.append(np.abs((gap * pair.target.normals[theirs]).sum(1)))
    distances = np.concatenate(within)
    if len(distances) == 0:
        return 0.0, 1.0
    close = float((distances <= TOUCHING * surfaces.spacing).mean())
    return close, min(1.0, float(np.median(np.concatenate(off))) / reach)
