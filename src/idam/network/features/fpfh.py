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

import torch
from torch import Tensor, nn

from idam.network.features.normals import (
    Neighbours,
    Reach,
    cloud_by_cloud,
    estimate_normals,
    find_neighbours,
    normal_reach,
    normals_from_neighbours,
)

__all__ = ["FPFH", "estimate_normals", "fpfh", "fpfh_of_neighbours"]

BINS = 11
# Angles (radians) closer than this count as equal where the outcome jumps: on flat surfaces they often are, and then
# rounding, and with it the cloud's pose, would decide. (Float32 resolves a sine near zero to 3e-4.)
TIE = 1e-3
# Points closer than this coincide: the inverse of its square, and a sum of many, is still a float32.
SAME_PLACE = 1e-15


@torch.no_grad()
def fpfh(points: Tensor, normals: Tensor, *, radius: float, max_neighbours: int) -> Tensor:
    """Fast point feature histograms.

    The neighbourhood is the point and its nearest ones within ``radius``, at most ``max_neighbours`` in all, as in
    Open3D's hybrid search. Neighbours at zero distance count in the middle bin of each angle, and add no histogram of
    their own. A point without neighbours has a histogram of zeros.

    Args:
        points: (B, N, 3), of any scale and any floating dtype; worked on in float32 or float64.
        normals: unit normals (B, N, 3). Which side they point to matters: turning all of them round changes the result.
        radius: of the neighbourhood, in the units of ``points``.
        max_neighbours: largest number of points in the neighbourhood, the point itself included.

    Returns:
        Features (B, N, 33), without gradient: 11 bins each of theta, phi and alpha, each 11 adding up to 200.
    """
    reach = Reach(radius, at_most=max_neighbours - 1)

    def describe(cloud: Tensor, normal: Tensor) -> Tensor:
        return fpfh_of_neighbours(cloud, normal, *find_neighbours(cloud, reach))

    return cloud_by_cloud(describe, points, normals)


class FPFH(nn.Module):
    """FPFH as a feature extractor without parameters: normals and histograms of a batch of clouds.

    The defaults are for clouds that fill the unit sphere.

    Args:
        normal_radius: radius of the neighbourhood that a normal is taken from.
        normal_neighbours: largest number of points in it, the point itself included.
        feature_radius: radius of the neighbourhood that a histogram is taken over.
        feature_neighbours: largest number of points in it, the point itself included.
    """

    channels = 3 * BINS
    rotation_invariant = True

    def __init__(
        self,
        normal_radius: float = 0.1,
        normal_neighbours: int = 30,
        feature_radius: float = 0.2,
        feature_neighbours: int = 100,
    ) -> None:
        super().__init__()
        self.normal_reach = normal_reach(normal_radius, normal_neighbours)
        self.feature_reach = Reach(feature_radius, at_most=feature_neighbours - 1)

    @torch.no_grad()
    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, 33) of ``points`` (B, N, 3): ``fpfh`` with the normals of ``estimate_normals``."""
        return cloud_by_cloud(self._describe, points)

    def _describe(self, points: Tensor) -> Tensor:
        near_for_normals, near = find_neighbours(points, self.normal_reach, self.feature_reach)
        return fpfh_of_neighbours(points, normals_from_neighbours(points, near_for_normals), near)


def fpfh_of_neighbours(points: Tensor, normals: Tensor, near: Neighbours) -> Tensor:
    """FPFH (B, N, 33) of ``points`` (B, N, 3) with ``normals`` (B, N, 3), by neighbourhoods found already."""
    shape = points.shape[:2]
    # coordinates first: sums over three slabs of pairs are several times as fast as sums over rows of three
    points, normals = points.flatten(0, 1).t().contiguous(), normals.flatten(0, 1).t().contiguous()
    offset = points.index_select(1, near.neighbour) - points.index_select(1, near.centre)
    distance = offset.square().sum(0).sqrt_()  # norm(dim=0) is many times as slow
    coincide = distance < SAME_PLACE
    direction = offset.div_(distance.clamp_min(SAME_PLACE))
    angles = _pair_angles(direction, normals.index_select(1, near.centre), normals.index_select(1, near.neighbour))
    spfh = _histograms(angles.masked_fill_(coincide, 0.5), near).to(points.dtype)

    weight = distance.square_().reciprocal_().masked_fill_(coincide, 0)
    total = near.sum(torch.cat([spfh, torch.ones_like(spfh[:, :1])], -1), weight)
    neighbours = total[:, :-1] / total[:, -1:].clamp_min(torch.finfo(points.dtype).tiny)
    return (spfh + neighbours).view(*shape, -1)


def _pair_angles(direction: Tensor, normal: Tensor, other_normal: Tensor) -> Tensor:
    """Theta, phi and alpha of pairs of points, each scaled to [0, 1]: (3, E).

    Pairs with the normal along the line between them have no frame and get the middle, 0.5, as in Open3D.

    Args:
        direction: unit vector (3, E) from the first point to the second.
        normal: the first point's normal (3, E).
        other_normal: the second point's normal (3, E).
    """
    first, second = (direction * normal).sum(0), (direction * other_normal).sum(0)
    swap = second.abs() > first.abs() + TIE
    a, b = torch.where(swap, -second, first), torch.where(swap, -first, second)
    cosine = (normal * other_normal).sum(0)
    sine = (1 - a * a).clamp_min_(0).sqrt_()

    theta = torch.atan2(b - a * cosine, sine * cosine)
    # opposite normals: -pi and pi are one angle but two bins, and Open3D's rounding mostly picks the first
    theta = torch.where(theta > math.pi - TIE, -math.pi, theta)
    phi = _determinant(direction, normal, other_normal) / sine
    angles = torch.stack([theta / math.pi, phi, a]).add_(1).div_(2)
    return angles.masked_fill_(sine < TIE, 0.5)


def _determinant(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """det(x, y, z) (E,) of vectors (3, E)."""
    return x[0] * (y[1] * z[2] - y[2] * z[1]) + x[1] * (y[2] * z[0] - y[0] * z[2]) + x[2] * (y[0] * z[1] - y[1] * z[0])


def _histograms(angles: Tensor, near: Neighbours) -> Tensor:
    """Percentages (P, 33) of each point's neighbours in each bin of the ``angles`` (3, E) in [0, 1]."""
    bins = (angles * BINS).long().clamp_(0, BINS - 1)
    bins += BINS * torch.arange(3, device=bins.device).unsqueeze(1) + 3 * BINS * near.centre
    points = len(near.counts)
    counts = torch.bincount(bins.flatten(), minlength=3 * BINS * points).view(points, 3 * BINS)
    return 100 * counts / near.counts.clamp_min(1).unsqueeze(1)
