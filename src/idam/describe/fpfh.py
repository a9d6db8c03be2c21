"""Fast point feature histograms (FPFH): 33 numbers a point that describe the surface around it, whatever its pose.

Rusu, Blodow and Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration", ICRA 2009, as Open3D's
``compute_fpfh_feature`` computes them. A pair of neighbours at p and q with unit normals m and n, d the unit vector
from p to q, is described by three angles in the frame u = m, v = d x u / |d x u|, w = u x v:

    theta = arctan2(w . n, u . n),    phi = v . n,    alpha = u . d

where p is the one of the two whose normal is nearer to the line between them. A point's simplified histogram (SPFH)
counts the angles over its neighbours, 11 bins for each angle, as percentages; its FPFH adds those of its neighbours j,
weighted by their distance r_j:

    FPFH(i) = SPFH(i) + sum_j r_j^-2 SPFH(j) / sum_j r_j^-2

The frame need not be built. With a = m . d, b = n . d, c = m . n and s = |d x m| = sqrt(1 - a^2),

    theta = arctan2(b - a c, s c),    phi = det(d, m, n) / s,    alpha = a

and exchanging the two points turns (a, b) into (-b, -a) and leaves c and the determinant as they are.
"""

from __future__ import annotations

import math

import numpy as np

from idam.describe.neighbours import Array, Neighbours, Reach, nearest_neighbours, within_reach

__all__ = ["BINS", "fpfh", "fpfh_from_neighbours"]

BINS = 11
# Angles (radians) closer than this count as equal where the outcome jumps: on flat surfaces they often are, and then
# rounding, and with it the cloud's pose, would decide. (Float32 resolves a sine near zero to 3e-4.)
TIE = 1e-3
# Points closer than this coincide: the inverse of its square, and a sum of many, is still a float32.
SAME_PLACE = 1e-15


def fpfh(points: Array, normals: Array, *, radius: float, max_neighbours: int) -> Array:
    """Fast point feature histograms.

    The neighbourhood is the point and its nearest ones within ``radius``, at most ``max_neighbours`` in all, as in
    Open3D's hybrid search. Neighbours at zero distance count in the middle bin of each angle, and add no histogram of
    their own. A point without neighbours has a histogram of zeros.

    Args:
        points: (N, 3), float32 or float64, of any scale.
        normals: unit normals (N, 3). Which side they point to matters: turning all of them round changes the result.
        radius: of the neighbourhood, in the units of ``points``.
        max_neighbours: largest number of points in the neighbourhood, the point itself included.

    Returns:
        Features (N, 33), in the dtype of ``points``: 11 bins each of theta, phi and alpha, each 11 adding up to 200.
    """
    reach = Reach(radius, at_most=max_neighbours - 1)
    return fpfh_from_neighbours(points, normals, within_reach(*nearest_neighbours(points, reach.at_most), reach))


def fpfh_from_neighbours(points: Array, normals: Array, near: Neighbours) -> Array:
    """FPFH (N, 33) of ``points`` (N, 3) with ``normals`` (N, 3), by neighbourhoods found already."""
    # coordinates first: sums over three slabs of pairs are several times as fast as sums over rows of three
    place, normal = np.ascontiguousarray(points.T), np.ascontiguousarray(normals.T)
    direction = place.take(near.neighbour, 1) - place.take(near.centre, 1)
    distance = np.sqrt(_dot(direction, direction))
    coincide = distance < SAME_PLACE
    distance = np.maximum(distance, SAME_PLACE)
    direction /= distance
    angles = _pair_angles(direction, normal.take(near.centre, 1), normal.take(near.neighbour, 1))
    angles[:, coincide] = 0.5
    spfh = _histograms(angles, near).astype(points.dtype)
    weight = np.square(distance)
    np.reciprocal(weight, out=weight)
    weight[coincide] = 0
    return spfh + _weighted_mean(spfh, weight, near)


def _pair_angles(direction: Array, normal: Array, other_normal: Array) -> Array:
    """Theta, phi and alpha of pairs of points, each scaled to [0, 1]: (3, E).

    Pairs with the normal along the line between them have no frame and get the middle, 0.5, as in Open3D.

    Args:
        direction: unit vector (3, E) from the first point to the second.
        normal: the first point's normal (3, E).
        other_normal: the second point's normal (3, E).
    """
    first, second = _dot(direction, normal), _dot(direction, other_normal)
    swap = np.abs(second) > np.abs(first) + TIE
    a, b = np.where(swap, -second, first), np.where(swap, -first, second)
    cosine = _dot(normal, other_normal)
    sine = np.sqrt(np.maximum(1 - a * a, 0))

    theta = np.arctan2(b - a * cosine, sine * cosine)
    # opposite normals: -pi and pi are one angle but two bins, and Open3D's rounding mostly picks the first
    theta[theta > math.pi - TIE] = -math.pi
    phi = _determinant(direction, normal, other_normal) / np.maximum(sine, TIE)
    angles = (np.stack([theta / math.pi, phi, a]) + 1) / 2
    angles[:, sine < TIE] = 0.5
    return angles


def _dot(x: Array, y: Array) -> Array:
    """Inner products (E,) of vectors (3, E)."""
    product: Array = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    return product


def _determinant(x: Array, y: Array, z: Array) -> Array:
    """det(x, y, z) (E,) of vectors (3, E)."""
    determinant: Array = (
        x[0] * (y[1] * z[2] - y[2] * z[1]) + x[1] * (y[2] * z[0] - y[0] * z[2]) + x[2] * (y[0] * z[1] - y[1] * z[0])
    )
    return determinant


def _histograms(angles: Array, near: Neighbours) -> Array:
    """Percentages (N, 33) of each point's neighbours in each bin of the ``angles`` (3, E) in [0, 1]."""
    bins = np.clip((angles * BINS).astype(np.intp), 0, BINS - 1)
    bins += BINS * np.arange(3)[:, None] + 3 * BINS * near.centre
    count = len(near.counts)
    counts = np.bincount(bins.ravel(), minlength=3 * BINS * count).reshape(count, 3 * BINS)
    return 100 * counts / np.maximum(near.counts, 1)[:, None]


def _weighted_mean(values: Array, weight: Array, near: Neighbours) -> Array:
    """Mean (N, C) over each point's neighbours j, weighted by ``weight`` (E,), of row j of ``values`` (N, C)."""
    mean = np.zeros_like(values)
    some = near.counts > 0
    if some.any():
        # points last: sums along them are twice as fast as sums of rows
        rows = np.ascontiguousarray(values.T).take(near.neighbour, 1)
        rows *= weight
        starts = (near.counts.cumsum() - near.counts)[some]
        total = np.maximum(np.add.reduceat(weight, starts), np.finfo(weight.dtype).tiny)
        mean[some] = (np.add.reduceat(rows, starts, axis=1) / total).T
    return mean
