"""Candidate transforms from the matches of invariant features: those sets of matches that agree on one rigid motion.

A rigid motion keeps distances: two right matches are as far apart in the source as in the target. Chen et al.,
"SC2-PCR: A Second Order Spatial Compatibility for Efficient and Robust Point Cloud Registration" (CVPR 2022), count for
each two compatible matches how many others both are compatible with. That number is large for two right ones and small
for two that agree by chance, so that even a few per cent of right matches stand out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.geometry import gather_points, weighted_procrustes
from idam.hypotheses import as_transform
from idam.network.features.fpfh import FPFH

__all__ = ["FeatureMatches", "agreeing_transforms", "match_features", "mutual_matches"]

Points = NDArray[np.float64]

NORMAL_SPACINGS = 2.5
"""Radius of FPFH's normals, in spacings of the points."""
FEATURE_SPACINGS = 6.0
"""Radius of FPFH's histograms, in spacings of the points."""
RANK = 2
"""Two points match where each is among the other's so many nearest in feature space."""
MATCHES = 1500
"""Matches at most, those of the most alike features: the compatibility matrix grows with their square."""
TOLERANCE = 1.5
"""Spacings by which distances between two matches may differ, and by which a match may miss."""
REACH = 1.7
"""Tolerances within which a refined transform counts as bringing a match together."""
FEW = 50
"""Matches that must be there before a share of them says much."""
SEEDS = 200
"""Matches from which a set of agreeing ones is grown."""
COMPANIONS = 20
"""Matches that a seed's first transform is solved from, besides itself."""
ROUNDS = 5
"""Times a seed's transform is solved anew, from the matches that it brings together."""


@dataclass(frozen=True)
class FeatureMatches:
    """Points (M, 3) of the source and of the target whose features are alike, and how far right ones may miss."""

    source: Tensor
    target: Tensor
    tolerance: float

    @cached_property
    def points(self) -> tuple[Points, Points]:
        """Source and target, (M, 3) each, as every transform is tried on them: in float64."""
        return self.source.double().numpy(), self.target.double().numpy()

    def weights(self, transformation: Points) -> Points:
        """How well a transform (4, 4) brings each match together, (M,): 1 at no distance, 0 from its reach on."""
        source, target = self.points
        moved = source @ transformation[:3, :3].T + transformation[:3, 3]
        miss = np.linalg.norm(moved - target, axis=1) / (REACH * self.tolerance)
        return np.asarray((1 - miss**2).clip(0))

    def support(self, transformation: Points) -> float:
        """Share of the matches that a transform (4, 4) brings together, in [0, 1]: low where there are few of them."""
        return float((self.weights(transformation) > 0).sum() / (len(self.source) + FEW))


@torch.inference_mode()
def match_features(source: Points, target: Points, spacing: float) -> FeatureMatches:
    """Matches of FPFH features, the most alike first.

    Args:
        source: points (N, 3).
        target: points (P, 3), in the same unit, in any pose.
        spacing: distance of a point to its nearest neighbour.
    """
    clouds = [torch.as_tensor(points, dtype=torch.float32) for points in (source, target)]
    describe = FPFH(NORMAL_SPACINGS * spacing, feature_radius=FEATURE_SPACINGS * spacing)
    pairs = mutual_matches(*(describe(cloud[None])[0] for cloud in clouds))
    return FeatureMatches(clouds[0][pairs[:, 0]], clouds[1][pairs[:, 1]], TOLERANCE * spacing)


def mutual_matches(source: Tensor, target: Tensor) -> Tensor:
    """Rows (M, 2) of features (N, K) and (P, K) where each is among the other's nearest, the most alike first."""
    # not as a matrix product: its last bits depend on the number of threads, and who is nearest on them
    distance = torch.cdist(source, target, compute_mode="donot_use_mm_for_euclid_dist")
    near = [
        torch.zeros_like(distance, dtype=torch.bool).scatter_(
            dim, distance.topk(min(RANK, distance.shape[dim]), dim, largest=False).indices, True
        )
        for dim in (0, 1)
    ]
    pairs = (near[0] & near[1]).nonzero()
    order = distance[pairs[:, 0], pairs[:, 1]].sort(stable=True).indices[:MATCHES]
    return pairs[order]


@torch.inference_mode()
def agreeing_transforms(matches: FeatureMatches) -> list[Points]:
    """Transforms (4, 4) that sets of matches agree on, the largest set first; many are alike.

    None where there are fewer than three matches.
    """
    source, target, tolerance = matches.source, matches.target, matches.tolerance
    if len(source) < 3:
        return []
    second_order = _second_order_compatibility(source, target, tolerance)
    seed = second_order.sum(1).sort(descending=True, stable=True).indices[:SEEDS]
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
    order = number.sort(descending=True, stable=True)
    return [as_transform(rotation[n], translation[n]) for n in order.indices.tolist()]


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
