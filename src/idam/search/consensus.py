"""Candidate transforms from the matches of invariant features: those sets of matches that agree on one rigid motion.

A rigid motion keeps distances: two right matches are as far apart in the source as in the target. Chen et al.,
"SC2-PCR: A Second Order Spatial Compatibility for Efficient and Robust Point Cloud Registration" (CVPR 2022), count for
each two compatible matches how many others both are compatible with. That number is large for two right ones and small
for two that agree by chance, so that even a few per cent of right matches stand out.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.network.geometry import gather_points, weighted_procrustes
from idam.network.propose import as_transforms
from idam.search.matching import FeatureMatches

__all__ = ["agreeing_transforms"]

Points = NDArray[np.float64]

COMPANIONS = 20
"""Matches that a seed's first transform is solved from, besides itself."""
ROUNDS = 3
"""Times a seed's transform is solved anew, from the matches that it brings together."""


@torch.inference_mode()
def agreeing_transforms(matches: FeatureMatches, seeds: int) -> list[Points]:
    """Transforms (4, 4) that sets of matches agree on, the largest set first; many are alike.

    Args:
        matches: of which some are right; where there are fewer than three, they agree on nothing.
        seeds: matches, the most compatible ones, from each of which a set of agreeing ones is grown.
    """
    source, target, tolerance = matches.source, matches.target, matches.tolerance
    if len(source) < 3:
        return []
    second_order = _second_order_compatibility(source, target, tolerance)
    seed = second_order.sum(1).sort(descending=True, stable=True).indices[:seeds]
    weight, companion = second_order[seed].topk(min(COMPANIONS, len(source)), 1)
    index = torch.cat([seed[:, None], companion], 1)
    # the seed itself is compatible with whatever its best companion is
    weight = torch.cat([weight[:, :1], weight], 1)
    sources, targets = (points.expand(len(seed), -1, -1) for points in (source, target))
    rotation, translation = weighted_procrustes(gather_points(sources, index), gather_points(targets, index), weight)
    for _ in range(ROUNDS):
        together = _brought_together(sources, targets, rotation, translation, tolerance)
        rotation, translation = weighted_procrustes(sources, targets, together)
    number = _brought_together(sources, targets, rotation, translation, tolerance).sum(1)
    order = number.sort(descending=True, stable=True).indices
    return as_transforms(rotation[order], translation[order])


def _second_order_compatibility(source: Tensor, target: Tensor, tolerance: float) -> Tensor:
    """For each two compatible matches how many others both are compatible with (M, M); 0 for incompatible ones."""
    first, second = (torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist") for x in (source, target))
    difference: Tensor = first - second
    compatible = (difference.abs() < tolerance).float().fill_diagonal_(0)
    return compatible * (compatible @ compatible)


def _brought_together(
    sources: Tensor, targets: Tensor, rotation: Tensor, translation: Tensor, tolerance: float
) -> Tensor:
    """1 for the matches (S, M) that each of S transforms brings within the tolerance, 0 for the others."""
    moved = sources @ rotation.transpose(-1, -2) + translation.unsqueeze(-2)
    near: Tensor = (moved - targets).norm(dim=-1) < tolerance
    return near.float()
