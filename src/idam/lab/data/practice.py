"""A protocol closer to practice than the paper's: two scans share a surface, but not one point of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from idam.lab.data.pairs import MAX_ANGLE, MAX_TRANSLATION, NOISE, NOISE_CLIP, Pairs, drawn_singly
from idam.network.geometry import (
    apply_transform,
    euler_xyz_to_rotation,
    gather_points,
    quaternion_to_rotation,
    random_rotation,
    rotations_within,
)

__all__ = ["KEPT", "fixed_practice_pairs", "make_practice_pairs"]

KEPT = 0.7
"""Share of each half that its half-space keeps."""


@dataclass(frozen=True)
class _Draw:
    """All that is random about B pairs."""

    order: Tensor
    direction: Tensor
    noise: Tensor
    angles: Tensor
    quaternion: Tensor
    translation: Tensor


def make_practice_pairs(points: Tensor, generator: torch.Generator, max_angle: float | None = None) -> Pairs:
    """Pairs from whole shapes (B, N, 3), drawn from ``generator`` as one batch.

    Source and target are disjoint random halves of the shape's points, each cropped by a half-space of its own to 70 %
    (the points lowest along a random direction), with noise N(0, 0.01), clipped to +-0.05, on every coordinate; the
    rotation is R = Rx Ry Rz with angles from U[0, 45] degrees, or about any axis; t from U[-0.5, 0.5]^3.

    Args:
        points: whole shapes (B, N, 3).
        generator: on the CPU.
        max_angle: largest angle, radians, of a rotation uniform over SO(3), of shapes in any pose; None for the angles
            above, of shapes as they are.
    """
    draw = _draw(len(points), points.shape[1], generator)
    if max_angle is None:
        return _build(points, draw, euler_xyz_to_rotation(draw.angles))
    # a network that is started from many rotations sees the target in all of its poses
    return _build(in_any_pose(points, generator), draw, rotations_within(len(points), max_angle, generator))


def in_any_pose(points: Tensor, generator: torch.Generator) -> Tensor:
    """The shapes (B, N, 3), each in a random rotation: in practice there is no common upright."""
    return points @ random_rotation(len(points), generator=generator).transpose(-1, -2)


def fixed_practice_pairs(points: Tensor, seed: int, *, any_rotation: bool) -> Pairs:
    """Test pairs from whole shapes (B, N, 3), with small rotations or any: each depends on the seed and its index."""
    drawn = drawn_singly(lambda generator: _draw(1, points.shape[1], generator), len(points), seed)
    rotation = quaternion_to_rotation(drawn.quaternion) if any_rotation else euler_xyz_to_rotation(drawn.angles)
    return _build(points, drawn, rotation)


def _draw(count: int, points: int, generator: torch.Generator) -> _Draw:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    return _Draw(
        order=uniform(count, points).argsort(-1),
        direction=normal(count, 2, 3),
        noise=(normal(count, 2, _kept(points), 3) * NOISE).clamp_(-NOISE_CLIP, NOISE_CLIP),
        angles=uniform(count, 3) * MAX_ANGLE,
        quaternion=normal(count, 4),
        translation=(uniform(count, 3) * 2 - 1) * MAX_TRANSLATION,
    )


def _kept(points: int) -> int:
    return math.floor(KEPT * (points // 2))


def _build(points: Tensor, draw: _Draw, rotation: Tensor) -> Pairs:
    half = points.shape[1] // 2
    source, target = (
        _cropped(gather_points(points, order), direction, _kept(points.shape[1])) + noise
        for order, direction, noise in zip(
            (draw.order[:, :half], draw.order[:, half : 2 * half]),
            draw.direction.unbind(1),
            draw.noise.unbind(1),
            strict=True,
        )
    )
    return Pairs(source, apply_transform(target, rotation, draw.translation), rotation, draw.translation)


def _cropped(points: Tensor, direction: Tensor, count: int) -> Tensor:
    """The points (B, count, 3) of (B, N, 3) that lie lowest along one direction each (B, 3), in their own order."""
    along = (points @ direction.unsqueeze(-1)).squeeze(-1)
    return gather_points(points, along.topk(count, largest=False).indices.sort(-1).values)
