"""Candidate transforms from the network: many starting rotations, run as one batch."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from idam.network.geometry import compose, gather_points, random_rotation
from idam.network.model import IDAM, KeyPoints

__all__ = ["as_transforms", "nearest_rotation", "propose", "starting_rotations"]

Points = NDArray[np.float64]


def starting_rotations(count: int, seed: int) -> torch.Tensor:
    """``count`` rotations (count, 3, 3), the identity and then the best spread of random ones for the seed.

    Each next one is the candidate farthest from all chosen so far, which covers SO(3) evenly.
    """
    generator = torch.Generator().manual_seed(seed)
    pool = torch.cat([torch.eye(3)[None], random_rotation(64 * count, generator=generator)])
    # tr(R_a^T R_b) falls with the angle between them: it is the similarity to keep small
    closest = torch.full((len(pool),), -torch.inf)
    chosen = [0]
    for _ in range(count - 1):
        closest = torch.maximum(closest, (pool * pool[chosen[-1]]).sum((-1, -2)))
        chosen.append(int(closest.argmin()))
    return pool[chosen]


@torch.inference_mode()
def propose(network: IDAM, source: Points, target: Points, starts: torch.Tensor) -> list[Points]:
    """A transform (4, 4) from each starting rotation (S, 3, 3) of the source, those the network trusts most first.

    Args:
        network: in evaluation mode.
        source: working points (N, 3).
        target: working points (P, 3).
        starts: rotations applied to the source before the network sees it.
    """
    device = next(network.parameters()).device
    starts = starts.to(device)
    target_keys = _key_points(network, target, torch.eye(3, device=device).expand_as(starts), same=True)
    source_keys = _key_points(network, source, starts, same=network.features.rotation_invariant)
    output = network.match(source_keys, target_keys)
    rotation, translation = compose(output.rotation, output.translation, starts, torch.zeros_like(output.translation))
    order = output.trust.sort(descending=True, stable=True).indices
    return as_transforms(rotation[order], translation[order])


def as_transforms(rotation: torch.Tensor, translation: torch.Tensor) -> list[Points]:
    """Rotations (S, 3, 3) and translations (S, 3) in single precision as S rigid transforms (4, 4) in double."""
    transformation = np.tile(np.eye(4), (len(rotation), 1, 1))
    transformation[:, :3, :3] = nearest_rotation(rotation.double().cpu().numpy())
    transformation[:, :3, 3] = translation.double().cpu().numpy()
    return list(transformation)


def _key_points(network: IDAM, points: Points, turns: torch.Tensor, *, same: bool) -> KeyPoints:
    """Key points of a cloud (N, 3) under each of S rotations (S, 3, 3), described once where all are the same."""
    cloud = torch.as_tensor(points, dtype=torch.float32, device=turns.device)[None]
    turned = cloud @ turns.transpose(-1, -2)
    described = cloud if same else turned
    keys = network.eliminate(described, network.features(described))
    index, features, significance = (
        x.expand(len(turns), *x.shape[1:]) for x in (keys.index, keys.features, keys.significance)
    )
    return KeyPoints(gather_points(turned, index), features, index, significance)


def nearest_rotation(matrix: Points) -> Points:
    """The rotation nearest to one (..., 3, 3) that is inexact: composed in single precision, or written briefly."""
    u, _, vh = np.linalg.svd(matrix)
    return np.asarray(u @ vh)
