"""Poses that a shape's symmetry makes as good as the true one: a table's half turn, any turn of a bottle."""

from __future__ import annotations

from typing import Any

import numpy as np
import small_gicp
import torch
from torch import Tensor

from idam.network.geometry import (
    apply_transform,
    gather_points,
    nearest,
    nearest_neighbours,
    rotation_angle,
    weighted_procrustes,
)

__all__ = ["right_up_to_symmetry", "surface_distance"]

Pose = tuple[Tensor, Tensor]
"""Rotations (n, 3, 3) and translations (n, 3)."""

SAME_SURFACE = 0.02
"""Mean distance, in the shapes' unit radii, below which a shape lies on itself. Of 20 shapes of each category it lets
pass 75 to 90 % of bottles turned about their axis and 55 % of tables given a half turn (the others differ in their
legs); no chair under a quarter or half turn, no table, chair or plane 10 degrees off, and no shape in a random pose."""
STEPS = 15
"""Of ICP, towards the nearest pose that puts the shape on itself."""
CHUNK = 32
"""Pairs whose distance matrices are in memory at a time."""


def right_up_to_symmetry(
    whole: Tensor,
    found: Pose,
    truth: Pose,
    within: tuple[float, float],
) -> Tensor:
    """Which of n answers are right, or would be if a pose that puts the shape on itself were the truth: (n,) bool.

    Such a pose is looked for near the answer, by ICP of the whole shape on itself. Being near one is more than lying
    near the true surface: a table that is 10 degrees off does as well.

    Args:
        whole: the shapes without noise and cropping, in the source's frame (n, W, 3).
        found: rotations (n, 3, 3) and translations (n, 3).
        truth: likewise.
        within: degrees and distance up to which an answer is right.
    """
    parts = []
    for start in range(0, len(whole), CHUNK):
        rows = slice(start, start + CHUNK)
        poses = [(rotation[rows].float(), translation[rows].float()) for rotation, translation in (found, truth)]
        parts.append(_right(whole[rows], poses[0], poses[1], within))
    return torch.cat(parts)


def surface_distance(moved: Tensor, still: Tensor) -> Tensor:
    """Mean distance (B,) of two samplings (B, W, 3) of surfaces, beyond that of two samplings of the same surface.

    The nearest point of another sampling of one surface is as far as the nearest other point of the same sampling.
    """
    own = gather_points(still, nearest_neighbours(still, 1).squeeze(-1))
    beyond: Tensor = nearest(moved, still)[0].sqrt().mean(-1) - (still - own).norm(dim=-1).mean(-1)
    return beyond


def _right(whole: Tensor, found: Pose, truth: Pose, within: tuple[float, float]) -> Tensor:
    # half of the points on the other half: a copy of the same points would fit its own sampling best, however it turns
    moving, still = whole[:, ::2], apply_transform(whole[:, 1::2], *truth)
    trees = [small_gicp.KdTree(cloud.numpy()) for cloud in still.double()]
    pose = found
    for _ in range(STEPS):
        match = gather_points(still, _nearest_by_tree(apply_transform(moving, *pose), trees))
        pose = weighted_procrustes(moving, match, torch.ones_like(moving[..., 0]))
    on_itself = surface_distance(apply_transform(moving, *pose), still) < SAME_SURFACE
    right: Tensor = _near(found, truth, within) | (_near(found, pose, within) & on_itself)
    return right


def _nearest_by_tree(points: Tensor, trees: list[Any]) -> Tensor:
    """Rows (B, W) of the points of each tree that are nearest to those of each cloud (B, W, 3).

    In an eighth of the time of all distances.
    """
    found = [
        tree.batch_knn_search(cloud.numpy(), 1, num_threads=1)[0][:, 0]
        for tree, cloud in zip(trees, points.double(), strict=True)
    ]
    return torch.from_numpy(np.stack(found).astype(np.int64))


def _near(one: Pose, other: Pose, within: tuple[float, float]) -> Tensor:
    angle = rotation_angle(one[0] @ other[0].transpose(-1, -2))
    near: Tensor = (angle <= within[0]) & ((one[1] - other[1]).norm(dim=-1) <= within[1])
    return near
