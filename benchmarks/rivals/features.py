"""Features of each cloud in view of the other, and the head that turns matches into a transform (DCP, PRNet)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from idam.network.geometry import weighted_procrustes

from .attention import Transformer
from .dgcnn import DGCNN
from .rival import Estimate

__all__ = ["FeatureConfig", "Features", "procrustes", "similarity"]


@dataclass(frozen=True)
class FeatureConfig:
    """Sizes of the network; the defaults are those of both papers.

    Attributes:
        neighbours: of the graph.
        widths: channels of the edge convolutions; the last is the transformer's.
        heads: of each attention.
        feed_forward: hidden channels of the transformer's MLPs.
    """

    neighbours: int = 20
    widths: tuple[int, ...] = (64, 64, 128, 256, 512)
    heads: int = 4
    feed_forward: int = 1024


class Features(nn.Module):
    """Phi_X = F_X + phi(F_X, F_Y) and the other way round (DCP, section 4.2): DGCNN, then a transformer as residual.

    Attributes:
        autocast: whether the transformer, most of the work, computes in bfloat16; never what touches coordinates.
    """

    def __init__(self, config: FeatureConfig) -> None:
        super().__init__()
        self.dgcnn = DGCNN(config.neighbours, config.widths)
        self.transformer = Transformer(config.widths[-1], config.heads, config.feed_forward)
        self.autocast = False

    def graphs(self, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The graphs of two clouds, for any rigid move of them."""
        return self.dgcnn.graph(source), self.dgcnn.graph(target)

    def forward(self, source: Tensor, target: Tensor, graphs: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Features (B, N, C) and (B, M, C) of (B, N, 3) and (B, M, 3)."""
        own, other = (self.dgcnn(points, graph) for points, graph in zip((source, target), graphs, strict=True))
        with torch.autocast(own.device.type, torch.bfloat16, enabled=self.autocast):
            told, told_other = self.transformer(own, other), self.transformer(other, own)
        return own + told.to(own.dtype), other + told_other.to(own.dtype)


def similarity(source_features: Tensor, target_features: Tensor) -> Tensor:
    """Phi_X Phi_Y^T / sqrt(C), (B, N, C) and (B, M, C) -> (B, N, M).

    The papers do not scale the products; unscaled, those of 512 channels start out one-hot and pass no gradient.
    """
    products = source_features @ target_features.transpose(-1, -2)
    return products / math.sqrt(source_features.shape[-1])


def procrustes(points: Tensor, matching: Tensor, target: Tensor) -> Estimate:
    """The transform from points (B, N, 3) to their matches (B, N, M) @ (B, M, 3) (DCP, section 4.4, by SVD)."""
    return Estimate(*weighted_procrustes(points, matching @ target, torch.ones_like(points[..., 0])))
