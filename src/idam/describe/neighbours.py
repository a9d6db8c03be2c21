"""The nearest neighbours of every point of a cloud, and those of them that are within reach.

The neighbourhoods of a cloud differ in size by a factor of a hundred, so they are kept as a list of pairs, not as a
(points, neighbours) table padded to the largest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Neighbours", "Reach", "nearest_neighbours", "within_reach"]

Array = NDArray[Any]
"""Numbers as they come: coordinates and features in float32 or float64, rows of points in whole numbers."""


class Reach(NamedTuple):
    """Who counts as a neighbour: the others nearer than ``radius``, at most and at least so many of the nearest."""

    radius: float
    at_most: int
    at_least: int = 0


class Neighbours(NamedTuple):
    """The pairs of neighbours in a cloud of N points, sorted by the first of the pair.

    Attributes:
        centre: (E,), row of the point whose neighbour it is.
        neighbour: (E,), row of the neighbour, never the point itself.
        counts: (N,), how many neighbours each point has.
    """

    centre: Array
    neighbour: Array
    counts: Array


def nearest_neighbours(points: Array, count: int) -> tuple[Array, Array]:
    """The ``count`` nearest others of every point, from near to far, fewer in a smaller cloud.

    Points at equal distances come in the order in which the tree finds them, which depends on nothing but the points.
    The search runs in one thread: a pool of threads would not survive a fork.

    Args:
        points: (N, 3).
        count: K.

    Returns:
        Distances (N, K), in the dtype of ``points``, and rows (N, K).

    Raises:
        ValueError: a coordinate is not finite.
    """
    import small_gicp

    cloud = np.asarray(points, np.float64)
    if not np.isfinite(cloud).all():  # a tree of them would crash
        raise ValueError("points must be finite: leave out NaN and infinity")
    near, square = small_gicp.KdTree(cloud).batch_knn_search(cloud, min(count + 1, len(cloud)), num_threads=1)
    others = near != np.arange(len(cloud))[:, None]
    others[others.all(1), -1] = False  # of more copies of a point than asked for, it need not be among the first itself
    near, square = (x[others].reshape(len(cloud), -1) for x in (near.astype(np.intp), square))
    return np.sqrt(square).astype(points.dtype), near


def within_reach(distance: Array, near: Array, reach: Reach) -> Neighbours:
    """Those of each point's nearest (N, K), at distances (N, K) from near to far, that are within reach."""
    distance, near = distance[:, : reach.at_most], near[:, : reach.at_most]
    chosen = distance < reach.radius
    chosen[:, : reach.at_least] = True
    counts = chosen.sum(1)
    return Neighbours(np.repeat(np.arange(len(near)), counts), near[chosen], counts)
