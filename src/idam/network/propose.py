"""What a network of the paper makes of two clouds, from a guess."""

from __future__ import annotations

import torch

from idam import rigid
from idam.network.model import IDAM
from idam.rigid import Array

__all__ = ["propose"]


@torch.inference_mode()
def propose(network: IDAM, source: Array, target: Array, guess: Array) -> Array:
    """The network's transform (4, 4), for a source that is rotated by the guess first.

    Args:
        network: in evaluation mode.
        source: (N, 3), in working coordinates, about the unit sphere.
        target: (P, 3), likewise.
        guess: (4, 4).
    """
    device = next(network.parameters()).device
    turned = source @ guess[:3, :3].T
    clouds = (torch.as_tensor(cloud, dtype=torch.float32, device=device)[None] for cloud in (turned, target))
    output = network(*clouds)
    rotation = rigid.nearest_rotation(output.rotation[0].double().cpu().numpy())
    return rigid.transform(rotation @ guess[:3, :3], output.translation[0].double().cpu().numpy())
