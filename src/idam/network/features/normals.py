"""Neighbours within a radius, and surface normals from them.

The neighbourhoods of a cloud differ in size by a factor of a hundred, so they are kept as a list of pairs, not as a
(points, neighbours) table padded to the largest. Everything here works on a batch of clouds laid end to end, P = B N
points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = [
    "Neighbours",
    "Reach",
    "among_nearest",
    "cloud_by_cloud",
    "estimate_normals",
    "find_neighbours",
    "nearest_neighbours_of",
    "normal_reach",
    "normals_from_neighbours",
]

# Points, itself included, that a normal is taken from where the radius holds fewer: any fewer span no plane.
FEWEST_POINTS = 3
# A neighbourhood is a line where its second variance is below this fraction of the first. The roots of the closed form
# are good to the square root of float64's precision there, 1e-8.
LINE = 1e-6
# A neighbourhood is a single place where its variance is below this fraction of the cloud's: float32's resolution.
PLACE = 1e-12
# How far off the centroid the normals' viewpoint lies, as a fraction of the cloud's root mean square radius.
OFF_CENTRE = 1e-3


class Reach(NamedTuple):
    """Who counts as a neighbour: the others nearer than ``radius``, at most and at least so many of the nearest."""

    radius: float
    at_most: int
    at_least: int = 0


class Neighbours(NamedTuple):
    """The pairs of neighbours in a batch of clouds laid end to end, sorted by the first of the pair.

    Attributes:
        centre: (E,), row in 0 .. P - 1 of the point whose neighbour it is.
        neighbour: (E,), row of the neighbour, a point of the same cloud and never the point itself.
        counts: (P,), how many neighbours each point has.
    """

    centre: Tensor
    neighbour: Tensor
    counts: Tensor

    def sum(self, values: Tensor, weight: Tensor | None = None) -> Tensor:
        """Sum over each point's neighbours j of ``weight`` (E,) times row j of ``values`` (P, C): (P, C)."""
        start = self.counts.cumsum(0) - self.counts
        return F.embedding_bag(self.neighbour, values, start, mode="sum", per_sample_weights=weight)


def cloud_by_cloud(function: Callable[..., Tensor], points: Tensor, *others: Tensor) -> Tensor:
    """Apply a function of one cloud to each of a batch of them, in float32 or float64.

    Args:
        function: takes a cloud (1, N, 3) of ``points`` and of each of the ``others``, and returns (1, N, C).
        points: (B, N, 3), of any floating dtype.
        others: more of the same shape.

    Returns:
        (B, N, C), in the dtype of ``points``.
    """
    if points.dim() != 3 or points.shape[-1] != 3 or points.numel() == 0:
        raise ValueError(f"points must be (B, N, 3), none of them 0, got {tuple(points.shape)}")
    dtype = torch.promote_types(points.dtype, torch.float32)
    clouds = zip(*(torch.split(x.to(dtype), 1) for x in (points, *others)), strict=True)
    return torch.cat([function(*cloud) for cloud in clouds]).to(points.dtype)


def find_neighbours(points: Tensor, *reaches: Reach) -> list[Neighbours]:
    """The neighbours of every point of a cloud (1, N, 3), for each of the ``reaches``, which share one search."""
    distance, near = nearest_neighbours_of(points[0], max(reach.at_most for reach in reaches))
    return [among_nearest(distance, near, reach) for reach in reaches]


def nearest_neighbours_of(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` nearest others of every point (N, 3), fewer in a smaller cloud: distances and rows, (N, K) each.

    By a tree, on the CPU: a matrix of all distances takes ten times as long from some thousand points on.

    Raises:
        ValueError: a coordinate is not finite.
    """
    import small_gicp

    cloud = points.detach().double().cpu().numpy()
    if not np.isfinite(cloud).all():  # a tree of them would crash
        raise ValueError("points must be finite: leave out NaN and infinity")
    tree = small_gicp.KdTree(cloud)
    near, square = tree.batch_knn_search(cloud, min(count + 1, len(cloud)), num_threads=torch.get_num_threads())
    others = near != np.arange(len(cloud))[:, None]
    others[others.all(1), -1] = False  # of more copies of a point than asked for, it need not be among the first itself
    near, square = (x[others].reshape(len(cloud), -1) for x in (near.astype(np.int64), square))
    return torch.from_numpy(np.sqrt(square)).to(points), torch.from_numpy(near).to(points.device)


def among_nearest(distance: Tensor, near: Tensor, reach: Reach) -> Neighbours:
    """Those of each point's nearest (N, K), by distance (N, K) from near to far, that are within reach."""
    chosen = distance < reach.radius
    chosen[:, : reach.at_least] = True
    chosen[:, reach.at_most :] = False
    centre, column = chosen.nonzero().unbind(1)
    return Neighbours(centre, near[centre, column], chosen.sum(1))


@torch.no_grad()
def estimate_normals(points: Tensor, *, radius: float, max_neighbours: int) -> Tensor:
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
        points: (B, N, 3), of any scale and any floating dtype; worked on in float32 or float64.
        radius: of the neighbourhood, in the units of ``points``.
        max_neighbours: largest number of points in the neighbourhood, the point itself included; at least 3.

    Returns:
        Unit normals (B, N, 3), without gradient.
    """
    reach = normal_reach(radius, max_neighbours)
    return cloud_by_cloud(lambda cloud: normals_from_neighbours(cloud, *find_neighbours(cloud, reach)), points)


def normal_reach(radius: float, max_neighbours: int) -> Reach:
    """Search for a normal's neighbourhood of at most ``max_neighbours`` points, the point itself included."""
    return Reach(radius, at_most=max_neighbours - 1, at_least=FEWEST_POINTS - 1)


def normals_from_neighbours(points: Tensor, near: Neighbours) -> Tensor:
    """Outward unit normals (B, N, 3) of ``points`` (B, N, 3) from their neighbourhoods."""
    centred = points.double()
    centred = centred - centred.mean(-2, keepdim=True)
    size = centred.square().sum(-1).mean(-1).sqrt()[:, None, None]
    centred = centred / size.clamp_min(torch.finfo(points.dtype).tiny)
    outward = (centred - OFF_CENTRE * _asymmetry(centred)).flatten(0, 1)
    normal = _least_variance(_covariance(centred.flatten(0, 1), near), outward)
    inward = (normal * outward).sum(-1, keepdim=True) < 0
    return torch.where(inward, -normal, normal).view_as(points).to(points.dtype)


def _asymmetry(centred: Tensor) -> Tensor:
    """Vector (B, 1, 3) that turns with the cloud ``centred`` (B, N, 3), and that leaves the plane of a flat cloud.

    With a = mean |p|^2 p and b = mean |p|^4 p, it is a / |a| + (a x b) / |a x b|.
    """
    square = centred.square().sum(-1, keepdim=True)
    third, fifth = (square * centred).mean(-2), (square.square() * centred).mean(-2)
    return (_unit(third) + _unit(torch.linalg.cross(third, fifth))).unsqueeze(-2)


def _covariance(points: Tensor, near: Neighbours) -> Tensor:
    """Covariance (P, 3, 3) of each of the ``points`` (P, 3) together with its neighbours."""
    product = points.unsqueeze(-1) * points.unsqueeze(-2)
    moments = torch.cat([points, product.flatten(1)], -1)
    moments = (moments + near.sum(moments)) / (1 + near.counts).unsqueeze(-1)
    mean, square = moments[:, :3], moments[:, 3:].view(-1, 3, 3)
    covariance = square - mean.unsqueeze(-1) * mean.unsqueeze(-2)
    is_place = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) < PLACE
    return covariance.masked_fill(is_place[:, None, None], 0)


def _least_variance(covariance: Tensor, outward: Tensor) -> Tensor:
    """Eigenvector (P, 3) of the smallest eigenvalue of ``covariance`` (P, 3, 3), of either sign.

    In closed form, 2.5 times as fast as ``torch.linalg.eigh``. C - l I, with l the smallest eigenvalue, has its rows
    in the plane of the other two eigenvectors, so the eigenvector is the cross product of two rows, the two that give
    the longest. Where l is a double eigenvalue the rows are all parallel: then it is the part of ``outward`` (P, 3)
    that is perpendicular to them, or, where there is none, of a coordinate axis.
    """
    rows = covariance - _smallest_eigenvalue(covariance)[:, None, None] * torch.eye(3).to(covariance)
    normal = _longest(torch.linalg.cross(rows, rows.roll(1, -2)))
    is_plane = normal.norm(dim=-1, keepdim=True) > LINE * rows.square().sum((-2, -1)).unsqueeze(-1)
    row = _unit(_longest(rows))
    axis = F.one_hot(row.abs().argmin(-1), 3).to(row)
    across = _without(outward, row)
    is_outward = across.norm(dim=-1, keepdim=True) > LINE * outward.norm(dim=-1, keepdim=True)
    return _unit(torch.where(is_plane, normal, torch.where(is_outward, across, _without(axis, row))))


def _smallest_eigenvalue(matrix: Tensor) -> Tensor:
    """Smallest eigenvalue (P,) of symmetric matrices A (P, 3, 3), by the trigonometric solution of the cubic.

    q + 2 p cos(arccos(det((A - q I) / p) / 2) / 3 + 2 pi / 3), q = tr(A) / 3, p^2 = |A - q I|^2 / 6.
    """
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)
    deviator = matrix - mean[:, None, None] * torch.eye(3).to(matrix)
    spread = (deviator.square().sum((-2, -1)) / 6).sqrt()
    deviator = deviator / spread.clamp_min(torch.finfo(matrix.dtype).tiny)[:, None, None]
    determinant = (deviator[:, 0] * torch.linalg.cross(deviator[:, 1], deviator[:, 2])).sum(-1)
    angle = (determinant / 2).clamp(-1, 1).acos() / 3
    smallest: Tensor = mean + 2 * spread * (angle + 2 * math.pi / 3).cos()
    return smallest


def _longest(vectors: Tensor) -> Tensor:
    """Longest (P, 3) of three vectors (P, 3, 3), given as rows."""
    index = vectors.square().sum(-1).argmax(-1)
    return vectors[torch.arange(len(vectors), device=vectors.device), index]


def _unit(vector: Tensor) -> Tensor:
    """Vectors (..., 3) scaled to length one, zero vectors left as they are."""
    return F.normalize(vector, dim=-1, eps=torch.finfo(vector.dtype).tiny)


def _without(vector: Tensor, direction: Tensor) -> Tensor:
    """Vectors (P, 3) less their part along a unit or zero ``direction`` (P, 3)."""
    return vector - (vector * direction).sum(-1, keepdim=True) * direction
