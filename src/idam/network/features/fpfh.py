"""FPFH (:mod:`idam.describe.fpfh`) as a feature extractor of the network."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from idam.describe.fpfh import BINS, fpfh_from_neighbours
from idam.describe.neighbours import Array, Reach, nearest_neighbours, within_reach
from idam.describe.normals import normal_reach, normals_from_neighbours

__all__ = ["FPFH"]


class FPFH(nn.Module):
    """FPFH as a feature extractor without parameters: normals and histograms of a batch of clouds.

    The defaults are for clouds that fill the unit sphere.

    Args:
        normal_radius: radius of the neighbourhood that a normal is taken from.
        normal_neighbours: largest number of points in it, the point itself included.
        feature_radius: radius of the neighbourhood that a histogram is taken over.
        feature_neighbours: largest number of points in it, the point itself included.
    """

    channels = 3 * BINS
    rotation_invariant = True

    def __init__(
        self,
        normal_radius: float = 0.1,
        normal_neighbours: int = 30,
        feature_radius: float = 0.2,
        feature_neighbours: int = 100,
    ) -> None:
        super().__init__()
        self.normal_reach = normal_reach(normal_radius, normal_neighbours)
        self.feature_reach = Reach(feature_radius, at_most=feature_neighbours - 1)

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, 33), without gradient, of ``points`` (B, N, 3), on their device and in their dtype.

        Raises:
            ValueError: the points are no batch of clouds, or not finite.
        """
        if points.dim() != 3 or points.shape[-1] != 3 or points.numel() == 0:
            raise ValueError(f"points must be (B, N, 3), none of them 0, got {tuple(points.shape)}")
        clouds = points.detach().to("cpu", torch.promote_types(points.dtype, torch.float32)).numpy()
        return torch.from_numpy(np.stack([self._describe(cloud) for cloud in clouds])).to(points)

    def _describe(self, points: Array) -> Array:
        distance, near = nearest_neighbours(points, max(self.normal_reach.at_most, self.feature_reach.at_most))
        normals = normals_from_neighbours(points, within_reach(distance, near, self.normal_reach))
        return fpfh_from_neighbours(points, normals, within_reach(distance, near, self.feature_reach))
