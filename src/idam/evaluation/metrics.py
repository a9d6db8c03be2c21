"""Errors of estimated transforms, as the paper's tables report them (section 4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from idam.geometry import rotation_angle, rotation_to_euler_zyx

__all__ = ["Metrics", "measure"]

RECALL_ANGLE = 5.0
RECALL_DISTANCE = 0.05


@dataclass(frozen=True)
class Metrics:
    """Errors over a set of pairs.

    Attributes:
        rmse_r: root mean square error of the zyx Euler angles, degrees.
        mae_r: mean absolute error of the zyx Euler angles, degrees.
        rmse_t: root mean square error of the translation's coordinates.
        mae_t: mean absolute error of the translation's coordinates.
        recall: share of pairs within 5 degrees and 0.05.
    """

    rmse_r: float
    mae_r: float
    rmse_t: float
    mae_t: float
    recall: float

    def to_dict(self) -> dict[str, float]:
        """The figures by name."""
        return asdict(self)


def measure(rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor) -> Metrics:
    """Compare n transforms, rotations (n, 3, 3) and translations (n, 3), with the truth.

    RMSE and MAE are over all 3 n Euler angles (differences wrapped to +-180 degrees) and all 3 n coordinates; recall
    takes the isotropic errors, the angle of R* R^T and |t - t*|.
    """
    rotation, true_rotation = rotation.double(), true_rotation.double()
    angles = rotation_to_euler_zyx(rotation) - rotation_to_euler_zyx(true_rotation)
    angles = (angles + 180.0).remainder(360.0) - 180.0
    offset = translation.double() - true_translation.double()
    turn = rotation_angle(true_rotation @ rotation.transpose(-1, -2))
    right = (turn <= RECALL_ANGLE) & (offset.norm(dim=-1) <= RECALL_DISTANCE)
    return Metrics(
        rmse_r=float(angles.square().mean().sqrt()),
        mae_r=float(angles.abs().mean()),
        rmse_t=float(offset.square().mean().sqrt()),
        mae_t=float(offset.abs().mean()),
        recall=float(right.to(torch.float64).mean()),
    )
