"""Surface normals: the direction of least variance of each point's neighbourhood, with the same sign in every pose."""

from __future__ import annotations

import math

import numpy as np

from idam.describe.neighbours import Array, Neighbours, Reach, nearest_neighbours, within_reach

__all__ = ["estimate_normals", "least_variance", "normal_reach", "normals_from_neighbours"]

# Points, itself included, that a normal is taken from where the radius holds fewer: any fewer span no plane.
FEWEST_POINTS = 3
# A neighbourhood is a line where its second variance is below this fraction of the first. The roots of the closed form
# are good to the square root of float64's precision there, 1e-8.
LINE = 1e-6
# A neighbourhood is a single place where its variance is below this fraction of the cloud's: float32's resolution.
PLACE = 1e-12
# How far off the centroid the normals' viewpoint lies, as a fraction of the cloud's root mean square radius.
OFF_CENTRE = 1e-3
TINY = float(np.finfo(np.float64).tiny)


def estimate_normals(points: Array, *, radius: float, max_neighbours: int) -> Array:
    """Surface normals: in each point's neighbourhood, the direction of least variance.

    The neighbourhood is the point and its nearest ones within ``radius``, at most ``max_neighbours`` in all (Open3D's
    hybrid search) and at least three, even if the nearest lie outside it. A neighbourhood on a line, or of a single
    place, has no direction of least variance; of those perpendicular to it, the one most outward is taken.

    The sign makes normals point away from a viewpoint at the cloud's centroid. For them to turn with the cloud, the
    sign may depend on nothing but the cloud; the centroid gives neighbours the same side, on flat surfaces too, where
    the neighbourhood itself shows none, and two views of an object differ little in it. A plane through the centroid
    has no outward side. So that its points agree on one still, and on the same in every pose, the viewpoint lies off
    the centroid by 0.1 % of the cloud's size, in a direction that the cloud's third and fifth moments give.

    Args:
        points: (N, 3), float32 or float64, of any scale.
        radius: of the neighbourhood, in the units of ``points``.
        max_neighbours: largest number of points in the neighbourhood, the point itself included; at least 3.

    Returns:
        Unit normals (N, 3), in the dtype of ``points``.
    """
    reach = normal_reach(radius, max_neighbours)
    return normals_from_neighbours(points, within_reach(*nearest_neighbours(points, reach.at_most), reach))


def normal_reach(radius: float, max_neighbours: int) -> Reach:
    """Search for a normal's neighbourhood of at most ``max_neighbours`` points, the point itself included."""
    return Reach(radius, at_most=max_neighbours - 1, at_least=FEWEST_POINTS - 1)


def normals_from_neighbours(points: Array, near: Neighbours) -> Array:
    """Outward unit normals (N, 3) of ``points`` (N, 3) from their neighbourhoods."""
    # float64: the closed form of the eigenvalues loses half the digits
    centred = points - points.mean(0, dtype=np.float64)
    centred /= max(np.sqrt(np.square(centred).sum(-1).mean()), float(np.finfo(points.dtype).tiny))
    outward = centred - OFF_CENTRE * _asymmetry(centred)
    normal, _ = least_variance(_covariance(centred, near), outward)
    inward = (normal * outward).sum(-1, keepdims=True) < 0
    return np.where(inward, -normal, normal).astype(points.dtype)


def _asymmetry(centred: Array) -> Array:
    """Vector (3,) that turns with the cloud ``centred`` (N, 3), and that leaves the plane of a flat cloud.

    With a = mean |p|^2 p and b = mean |p|^4 p, it is a / |a| + (a x b) / |a x b|.
    """
    square = np.square(centred).sum(-1, keepdims=True)
    third, fifth = (square * centred).mean(0), (np.square(square) * centred).mean(0)
    asymmetry: Array = _unit(third) + _unit(np.cross(third, fifth))
    return asymmetry


def _covariance(points: Array, near: Neighbours) -> Array:
    """Covariance (N, 3, 3) of each of the ``points`` (N, 3) together with its neighbours."""
    x, y, z = points.T
    moments = np.stack([x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    count = len(points)
    around = np.stack([np.bincount(near.centre, row[near.neighbour], count) for row in moments])
    moments = (moments + around) / (1 + near.counts)
    mean, square = moments[:3].T, moments[[3, 4, 5, 4, 6, 7, 5, 7, 8]].T.reshape(-1, 3, 3)
    covariance: Array = square - mean[:, :, None] * mean[:, None, :]
    covariance[np.trace(covariance, axis1=1, axis2=2) < PLACE] = 0
    return covariance


def least_variance(covariance: Array, outward: Array) -> tuple[Array, Array]:
    """Eigenvector (N, 3) of the smallest eigenvalue of ``covariance`` (N, 3, 3), of either sign, and that value (N,).

    In closed form, several times as fast as ``np.linalg.eigh``. C - l I, with l the smallest eigenvalue, has its rows
    in the plane of the other two eigenvectors, so the eigenvector is the cross product of two rows, the two that give
    the longest. Where l is a double eigenvalue the rows are all parallel: then it is the part of ``outward`` (N, 3)
    that is perpendicular to them, or, where there is none, of a coordinate axis.
    """
    smallest = _smallest_eigenvalue(covariance)
    rows = covariance - smallest[:, None, None] * np.eye(3)
    normal = _longest(_cross(rows, rows[:, [2, 0, 1]]))
    is_plane = _norm(normal) > LINE * np.square(rows).sum((-2, -1))[:, None]
    if is_plane.all():
        return _unit(normal), smallest
    row = _unit(_longest(rows))
    axis = np.eye(3)[np.abs(row).argmin(-1)]
    across = _without(outward, row)
    is_outward = _norm(across) > LINE * _norm(outward)
    return _unit(np.where(is_plane, normal, np.where(is_outward, across, _without(axis, row)))), smallest


def _smallest_eigenvalue(matrix: Array) -> Array:
    """Smallest eigenvalue (N,) of symmetric matrices A (N, 3, 3), by the trigonometric solution of the cubic.

    q + 2 p cos(arccos(det((A - q I) / p) / 2) / 3 + 2 pi / 3), q = tr(A) / 3, p^2 = |A - q I|^2 / 6.
    """
    mean = np.trace(matrix, axis1=1, axis2=2) / 3
    deviator = matrix - mean[:, None, None] * np.eye(3)
    spread = np.sqrt(np.square(deviator).sum((-2, -1)) / 6)
    deviator /= np.maximum(spread, TINY)[:, None, None]
    determinant = (deviator[:, 0] * _cross(deviator[:, 1], deviator[:, 2])).sum(-1)
    angle = np.arccos(np.clip(determinant / 2, -1, 1)) / 3
    smallest: Array = mean + 2 * spread * np.cos(angle + 2 * math.pi / 3)
    return smallest


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors (..., 3); ``np.cross`` takes several times as long."""
    product: Array = a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
    return product


def _longest(vectors: Array) -> Array:
    """Longest (N, 3) of three vectors (N, 3, 3), given as rows."""
    longest: Array = vectors[np.arange(len(vectors)), np.square(vectors).sum(-1).argmax(-1)]
    return longest


def _norm(vector: Array) -> Array:
    """Lengths (..., 1) of vectors (..., 3)."""
    length: Array = np.sqrt(np.square(vector).sum(-1, keepdims=True))
    return length


def _unit(vector: Array) -> Array:
    """Vectors (..., 3) scaled to length one, zero vectors left as they are."""
    unit: Array = vector / np.maximum(_norm(vector), TINY)
    return unit


def _without(vector: Array, direction: Array) -> Array:
    """Vectors (N, 3) less their part along a unit or zero ``direction`` (N, 3)."""
    rest: Array = vector - (vector * direction).sum(-1, keepdims=True) * direction
    return rest
