"""Neighbours within a radius, and surface normals from them.

The neighbourhoods of a cloud differ in size by a factor of a hundred, so they are kept as a list of pairs, not as a
(points, neighbours) table padded to the largest. Everything here works on a batch of clouds laid end to end, P = B N
points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["Neighbours", "Reach", "by_memory", "estimate_normals", "find_neighbours", "normals_from_neighbours"]

# Entries of the largest distance matrix held at a time: bounds memory, and keeps the matrix in the processor's cache.
DISTANCES = 2**21
# Points, itself included, that a normal is taken from where the radius holds fewer: any fewer span no plane.
FEWEST_POINTS = 3
# A neighbourhood is a line where its second variance is below this fraction of the first. The roots of the closed form
# are good to the square root of float64's precision there, 1e-8.
LINE = 1e-6
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
        count: (P,), how many neighbours each point has.
    """

    centre: Tensor
    neighbour: Tensor
    count: Tensor

    def sum(self, values: Tensor, weight: Tensor | None = None) -> Tensor:
        """Sum over each point's neighbours j of ``weight`` (E,) times row j of ``values`` (P, C): (P, C)."""
        start = self.count.cumsum(0) - self.count
        return F.embedding_bag(self.neighbour, values, start, mode="sum", per_sample_weights=weight)


def by_memory(points: Tensor) -> Iterator[slice]:
    """Ranges of clouds of ``points`` (B, N, 3), together the batch, each small enough to be worked on at a time."""
    batch, size, _ = points.shape
    step = max(1, DISTANCES // max(1, size * size))
    for start in range(0, batch, step):
        yield slice(start, start + step)


def find_neighbours(points: Tensor, *reaches: Reach) -> list[Neighbours]:
    """The neighbours of every point in its own cloud, for each of the ``reaches``.

    Args:
        points: (B, N, 3), a part of the batch as ``by_memory`` deals them out: one cloud, or several small ones.
        reaches: the searches to do; they share the distances.
    """
    batch, size, _ = points.shape
    rows = max(1, DISTANCES // (batch * size))  # all of them, unless one cloud alone is too large
    pairs: list[list[Tensor]] = [[] for _ in reaches]
    for start in range(0, size, rows):
        # by differences: the faster way over |a|^2 + |b|^2 - 2 ab cancels, and in TF32 has three digits to begin with
        part = points[:, start : start + rows]
        distance = torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist")
        distance.diagonal(offset=start, dim1=-2, dim2=-1).fill_(torch.inf)
        for found, reach in zip(pairs, reaches, strict=True):
            found.append(_select(distance.flatten(0, 1), reach).flatten().nonzero().squeeze(1) + start * size)
    return [_as_neighbours(torch.cat(found), batch, size) for found in pairs]


def _select(distance: Tensor, reach: Reach) -> Tensor:
    """Which entries of ``distance`` (P, N) are within reach of their row's point: (P, N) bool."""
    chosen = distance < reach.radius
    count = chosen.sum(-1, dtype=torch.int32)
    at_least = min(reach.at_least, distance.shape[-1] - 1)
    for wrong, k in ((count > reach.at_most, reach.at_most), (count < at_least, at_least)):
        row = wrong.nonzero().squeeze(1)
        nearest = distance[row].topk(k, largest=False, sorted=False).indices
        chosen[row] = False
        chosen[row.unsqueeze(1), nearest] = True
    return chosen


def _as_neighbours(pair: Tensor, batch: int, size: int) -> Neighbours:
    """Sorted positions (E,) in the (B, N, N) table of pairs as rows of the clouds laid end to end."""
    centre = pair // size
    neighbour = pair - centre * size + centre // size * size
    return Neighbours(centre, neighbour, torch.bincount(centre, minlength=batch * size))


@torch.no_grad()
def estimate_normals(points: Tensor, *, radius: float, max_neighbours: int) -> Tensor:
    """Surface normals: in each point's neighbourhood, the direction of least variance.

    The neighbourhood is the point and its nearest ones within ``radius``, at most ``max_neighbours`` in all (Open3D's
    hybrid search) and at least three, even if the nearest lie outside it. A neighbourhood on a line, or of a single
    place, has no direction of least variance; of those perpendicular to it, the one most outward is taken.

    The sign makes the normal point away from a viewpoint just off the cloud's centroid. For a normal to turn with the
    cloud, its sign may depend on nothing but the cloud, and of all vectors that do, those from the centroid vary least
    from point to point and between two views of an object. Planes through the centroid itself have no outward side; so
    that their points still agree on one, the viewpoint lies off the centroid by 0.1 % of the cloud's size, in a
    direction given by its third and fifth moments. A rotation of the cloud turns them with it.

    Args:
        points: (B, N, 3), of any scale and any floating dtype; worked on in float32 or float64.
        radius: of the neighbourhood, in the units of ``points``.
        max_neighbours: largest number of points in the neighbourhood, the point itself included; at least 3.

    Returns:
        Unit normals (B, N, 3), without gradient.
    """
    points, dtype = points.detach().to(torch.promote_types(points.dtype, torch.float32)), points.dtype
    reach = normal_reach(radius, max_neighbours)
    normals = torch.empty_like(points)
    for part in by_memory(points):
        (near,) = find_neighbours(points[part], reach)
        normals[part] = normals_from_neighbours(points[part], near)
    return normals.to(dtype)


def normal_reach(radius: float, max_neighbours: int) -> Reach:
    """The search for a normal's neighbourhood of at most ``max_neighbours`` points, the point itself included."""
    return Reach(radius, at_most=max_neighbours - 1, at_least=FEWEST_POINTS - 1)


def normals_from_neighbours(points: Tensor, near: Neighbours) -> Tensor:
    """Outward unit normals (B, N, 3) of ``points`` (B, N, 3) from their neighbourhoods."""
    centred = points.double() - points.double().mean(-2, keepdim=True)
    centred = centred / centred.square().sum(-1).mean(-1).sqrt().clamp_min(torch.finfo(points.dtype).tiny)[:, None, None]
    outward = (centred - OFF_CENTRE * _asymmetry(centred)).flatten(0, 1)
    normal = _least_variance(_covariance(centred.flatten(0, 1), near), outward)
    inward = (normal * outward).sum(-1, keepdim=True) < 0
    return torch.where(inward, -normal, normal).view_as(points).to(points.dtype)


def _asymmetry(centred: Tensor) -> Tensor:
    """A vector (B, 1, 3) that turns with the cloud ``centred`` (B, N, 3), and that leaves the plane of a flat cloud.

    With a = mean |p|^2 p and b = mean |p|^4 p, it is a / |a| + (a x b) / |a x b|.
    """
    square = centred.square().sum(-1, keepdim=True)
    third, fifth = (square * centred).mean(-2), (square.square() * centred).mean(-2)
    return (F.normalize(third, dim=-1) + F.normalize(torch.linalg.cross(third, fifth), dim=-1)).unsqueeze(-2)


def _covariance(points: Tensor, near: Neighbours) -> Tensor:
    """Covariance (P, 3, 3) of each of the ``points`` (P, 3) together with its neighbours."""
    product = points.unsqueeze(-1) * points.unsqueeze(-2)
    moments = torch.cat([points, product.flatten(1)], -1)
    moments = (moments + near.sum(moments)) / (1 + near.count).unsqueeze(-1)
    mean, square = moments[:, :3], moments[:, 3:].unflatten(1, (3, 3))
    return square - mean.unsqueeze(-1) * mean.unsqueeze(-2)


def _least_variance(covariance: Tensor, outward: Tensor) -> Tensor:
    """The eigenvector (P, 3) of the smallest eigenvalue of ``covariance`` (P, 3, 3), of either sign.

    In closed form, thirty times as fast as ``torch.linalg.eigh``. C - l I, with l the smallest eigenvalue, has its rows
    in the plane of the other two eigenvectors, so the eigenvector is the cross product of two rows, the two that give
    the longest. Where l is a double eigenvalue the rows are all parallel: then it is the part of ``outward`` (P, 3)
    that is perpendicular to them, or, where there is none, of a coordinate axis.
    """
    rows = covariance - _smallest_eigenvalue(covariance)[:, None, None] * torch.eye(3).to(covariance)
    normal = _longest(torch.linalg.cross(rows, rows.roll(1, -2)))
    row = F.normalize(_longest(rows), dim=-1)
    axis = F.one_hot(row.abs().argmin(-1), 3).to(row)
    across, aside = _without(outward, row), _without(axis, row)
    across = torch.where(_is_small(across, outward), aside, across)
    is_line = normal.norm(dim=-1, keepdim=True) <= LINE * rows.square().sum((-2, -1)).unsqueeze(-1)
    return F.normalize(torch.where(is_line, across, normal), dim=-1, eps=torch.finfo(normal.dtype).tiny)
