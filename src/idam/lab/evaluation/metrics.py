"""Errors of estimated transforms, as the paper's tables report them (section 4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from idam.lab.data.pairs import Pairs
from idam.network.geometry import apply_transform, nearest, rotation_angle, rotation_to_euler_zyx

__all__ = ["WITHIN", "Metrics", "measure", "modified_chamfer", "motion_error"]

WITHIN = (5.0, 0.05)
"""Degrees and distance up to which a pair counts as right."""

CHUNK = 64
"""Pairs whose distance matrices are in memory at a time."""


@dataclass(frozen=True)
class Metrics:
    """Errors over a set of pairs.

    Attributes:
        rmse_r: root mean square error of the zyx Euler angles, degrees.
        mae_r: mean absolute error of the zyx Euler angles, degrees.
        rmse_t: root mean square error of the translation's coordinates.
        mae_t: mean absolute error of the translation's coordinates.
        recall: share of pairs whose errors are within bounds, 5 degrees and 0.05 unless others are given.
        angle: mean angle of R* R^T, degrees.
        distance: mean of |t - t*|.
    """

    rmse_r: float
    mae_r: float
    rmse_t: float
    mae_t: float
    recall: float
    angle: float
    distance: float

    def to_dict(self) -> dict[str, float]:
        """The figures by name."""
        return asdict(self)


def motion_error(
    found: NDArray[np.float64], truth: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[float, float]:
    """Degrees between two transforms (4, 4), and the distance between where they move the source's centre (3,)."""
    degrees = np.degrees(Rotation.from_matrix(found[:3, :3].T @ truth[:3, :3]).magnitude())
    apart = (found - truth) @ [*centre, 1.0]
    return float(degrees), float(np.linalg.norm(apart))


def measure(
    rotation: Tensor,
    translation: Tensor,
    true_rotation: Tensor,
    true_translation: Tensor,
    within: tuple[float, float] = WITHIN,
) -> Metrics:
    """Compare n transforms, rotations (n, 3, 3) and translations (n, 3), with the truth.

    RMSE and MAE are over all 3 n Euler angles (differences wrapped to +-180 degrees) and all 3 n coordinates; recall
    takes the isotropic errors, the angle of R* R^T and |t - t*|.
    """
    rotation, true_rotation = rotation.double(), true_rotation.double()
    angles = rotation_to_euler_zyx(rotation) - rotation_to_euler_zyx(true_rotation)
    angles = (angles + 180.0).remainder(360.0) - 180.0
    offset = translation.double() - true_translation.double()
    turn = rotation_angle(true_rotation @ rotation.transpose(-1, -2))
    right = (turn <= within[0]) & (offset.norm(dim=-1) <= within[1])
    return Metrics(
        rmse_r=float(angles.square().mean().sqrt()),
        mae_r=float(angles.abs().mean()),
        rmse_t=float(offset.square().mean().sqrt()),
        mae_t=float(offset.abs().mean()),
        recall=float(right.to(torch.float64).mean()),
        angle=float(turn.mean()),
        distance=float(offset.norm(dim=-1).mean()),
    )


def modified_chamfer(pairs: Pairs, whole: Tensor, rotation: Tensor, translation: Tensor) -> float:
    """Mean modified Chamfer distance of n pairs: each cloud against the other's whole, clean shape.

    mean_i min_q |R p_i + t - q|^2 + mean_j min_p |q_j - (R p + t)|^2, with q of the whole shape where it truly lies and
    p of the whole shape where the source was (Yew and Lee, RPM-Net, CVPR 2020, section 5.1). Unlike the angle it
    forgives a turn about an axis of symmetry.

    Args:
        pairs: n pairs.
        whole: their shapes without noise and cropping, in the source's frame (n, W, 3).
        rotation: estimates (n, 3, 3).
        translation: estimates (n, 3).
    """
    rotation, translation = rotation.float(), translation.float()
    total = 0.0
    for start in range(0, len(pairs), CHUNK):
        rows = slice(start, start + CHUNK)
        chunk, move = pairs[rows], (rotation[rows], translation[rows])
        true_whole = apply_transform(whole[rows], chunk.rotation, chunk.translation)
        to_target, _ = nearest(apply_transform(chunk.source, *move), true_whole)
        to_source, _ = nearest(chunk.target, apply_transform(whole[rows], *move))
        total += float((to_target.mean(-1) + to_source.mean(-1)).sum())
    return total / len(pairs)
