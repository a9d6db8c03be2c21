"""Rigid transforms from twists, for methods that step along them."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["twist_to_transform"]


def twist_to_transform(twist: Tensor) -> tuple[Tensor, Tensor]:
    """The exponential of twists (..., 6), rotation vector first: rotation (..., 3, 3) and translation (..., 3).

    exp [[w]x, v; 0, 0]; differentiable everywhere, the zero twist included.
    """
    w_x, w_y, w_z, v_x, v_y, v_z = twist.unbind(-1)
    zero = torch.zeros_like(w_x)
    rows = [[zero, -w_z, w_y, v_x], [w_z, zero, -w_x, v_y], [-w_y, w_x, zero, v_z], [zero] * 4]
    transform = torch.linalg.matrix_exp(torch.stack([torch.stack(row, -1) for row in rows], -2))
    return transform[..., :3, :3], transform[..., :3, 3]
