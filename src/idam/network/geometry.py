"""Rigid transforms, weighted Procrustes and nearest neighbours, batched over any leading shape ``...``.

Column vectors throughout: a rotation ``R`` (..., 3, 3) and a translation ``t`` (..., 3) take a point ``p`` to
``R p + t``, which for points stored as rows is ``points @ R^T + t``. Rotations are right-handed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = [
    "apply_transform",
    "compose",
    "euler_xyz_to_rotation",
    "gather_points",
    "invert",
    "nearest",
    "nearest_neighbours",
    "quaternion_to_rotation",
    "random_rotation",
    "rotation_angle",
    "rotation_to_euler_zyx",
    "rotations_within",
    "square_distance",
    "weighted_procrustes",
]


def apply_transform(points: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Move points (..., N, 3) by ``R p + t``."""
    return points @ rotation.transpose(-1, -2) + translation.unsqueeze(-2)


def compose(
    second_rotation: Tensor, second_translation: Tensor, first_rotation: Tensor, first_translation: Tensor
) -> tuple[Tensor, Tensor]:
    """The transform that applies ``first`` and then ``second``: (R2 R1, R2 t1 + t2)."""
    rotation = second_rotation @ first_rotation
    translation = (second_rotation @ first_translation.unsqueeze(-1)).squeeze(-1) + second_translation
    return rotation, translation


def invert(rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse transform, (R^T, -R^T t)."""
    inverse = rotation.transpose(-1, -2)
    return inverse, -(inverse @ translation.unsqueeze(-1)).squeeze(-1)


def euler_xyz_to_rotation(angles: Tensor) -> Tensor:
    """R = Rx(a) Ry(b) Rz(c) for ``angles`` (..., 3) = (a, b, c) in radians (the paper's protocol, section 4)."""
    (sin_a, sin_b, sin_c), (cos_a, cos_b, cos_c) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = [
        [cos_b * cos_c, -cos_b * sin_c, sin_b],
        [sin_a * sin_b * cos_c + cos_a * sin_c, -sin_a * sin_b * sin_c + cos_a * cos_c, -sin_a * cos_b],
        [-cos_a * sin_b * cos_c + sin_a * sin_c, cos_a * sin_b * sin_c + sin_a * cos_c, cos_a * cos_b],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def rotation_to_euler_zyx(rotation: Tensor) -> Tensor:
    """Euler angles (..., 3) = (z, y, x) in degrees with R = Rz Ry Rx: the angles of the error metrics.

    At gimbal lock (|y| = 90 degrees) the x angle carries the whole turn and z is 0.
    """
    sin_y = -rotation[..., 2, 0]
    cos_y = torch.hypot(rotation[..., 0, 0], rotation[..., 1, 0])
    locked = cos_y < 1e-6
    z = torch.atan2(rotation[..., 1, 0], rotation[..., 0, 0])
    x = torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2])
    x_locked = torch.atan2(-rotation[..., 1, 2], rotation[..., 1, 1])
    y = torch.atan2(sin_y, cos_y)
    return torch.stack([z.masked_fill(locked, 0.0), y, torch.where(locked, x_locked, x)], -1) * (180.0 / math.pi)


def rotation_angle(rotation: Tensor) -> Tensor:
    """The angle of each rotation (..., 3, 3) in degrees, accurate near 0 and near 180."""
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    skew = rotation - rotation.transpose(-1, -2)
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    return torch.atan2(axis.norm(dim=-1), trace - 1.0) * (180.0 / math.pi)


def random_rotation(
    count: int, *, generator: torch.Generator | None = None, dtype: torch.dtype | None = None
) -> Tensor:
    """``count`` rotations (count, 3, 3) drawn uniformly from SO(3), from normalised Gaussian quaternions."""
    return quaternion_to_rotation(torch.randn(count, 4, generator=generator, dtype=dtype))


def rotations_within(count: int, max_angle: float, generator: torch.Generator) -> Tensor:
    """Rotations (count, 3, 3) about uniform axes, uniform in SO(3) up to an angle in radians."""
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    # the angle's distribution function in SO(3) is (a - sin a) / pi, inverted on a table
    angles = torch.linspace(0, max_angle, 1024)
    share = (angles - angles.sin()) / (max_angle - math.sin(max_angle))
    angle = angles[torch.searchsorted(share, torch.rand(count, generator=generator)).clamp_max(1023)]
    return quaternion_to_rotation(torch.cat([(angle / 2).cos()[:, None], axis * (angle / 2).sin()[:, None]], -1))


def quaternion_to_rotation(quaternion: Tensor) -> Tensor:
    """Rotation (..., 3, 3) of a quaternion (..., 4), scalar first, of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def weighted_procrustes(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The rigid transform minimising ``sum_i w_i |R p_i + t - q_i|^2`` (section 3.3.2, equation 8).

    Both clouds are centred on their *weighted* means: with plain means the optimum is another one whenever the weights
    are not uniform. Solved by the SVD of the weighted covariance, with the determinant fixed to +1.

    Args:
        source: points p (..., N, 3).
        target: their matches q (..., N, 3).
        weight: non-negative weights (..., N), of any scale; where all are zero, they count as equal.

    Returns:
        Rotation (..., 3, 3) and translation (..., 3). Degenerate input (collinear points, a single positive weight)
        leaves part of the rotation free; it is still a rotation, and finite.
    """
    total = weight.sum(-1, keepdim=True)
    weight = torch.where(total > 0, weight / total.clamp_min(torch.finfo(weight.dtype).tiny), 1.0 / weight.shape[-1])
    weight = weight.unsqueeze(-1)
    source_mean, target_mean = (weight * source).sum(-2, keepdim=True), (weight * target).sum(-2, keepdim=True)
    covariance = (weight * (source - source_mean)).transpose(-1, -2) @ (target - target_mean)
    u, _, vh = torch.linalg.svd(covariance)
    v = vh.transpose(-1, -2)
    sign = torch.ones_like(covariance[..., 0])
    sign[..., 2] = torch.det(v @ u.transpose(-1, -2)).sign()
    rotation = (v * sign.unsqueeze(-2)) @ u.transpose(-1, -2)
    translation = target_mean - source_mean @ rotation.transpose(-1, -2)
    return rotation, translation.squeeze(-2)


def square_distance(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (..., N, M) between points (..., N, 3) and (..., M, 3).

    By |a|^2 + |b|^2 - 2 ab, one matrix product; centre the clouds first where coordinates are large.
    """
    product = a @ b.transpose(-1, -2)
    return (a.square().sum(-1).unsqueeze(-1) + b.square().sum(-1).unsqueeze(-2)).sub_(product, alpha=2.0).clamp_min_(0)


def nearest_neighbours(points: Tensor, k: int) -> Tensor:
    """Indices (..., N, k) of the k nearest other points of each point (..., N, 3), nearest first."""
    distance = square_distance(points, points)
    distance.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    return distance.topk(k, dim=-1, largest=False).indices


def nearest(query: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distance (..., N) to, and index (..., N) of, the point (..., M, 3) nearest to each query (..., N, 3)."""
    distance, index = square_distance(query, points).min(-1)
    return distance, index


def gather_points(values: Tensor, index: Tensor) -> Tensor:
    """Rows of ``values`` (B, N, C) at ``index`` (B, M): (B, M, C)."""
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))
