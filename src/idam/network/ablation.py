"""What stands in for each of the paper's parts where the ablation takes it out (section 4.6)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["EqualValidity", "InnerProduct", "RandomSignificance", "inner_products"]


class InnerProduct(nn.Module):
    """Instead of the similarity matrix convolution: the inner product of both features, over the root of their size.

    Without the root, the softmax of 64 products of about unit size would be a one-hot from the start, and learn slowly.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(
        self, source: Tensor, target: Tensor, source_features: Tensor, target_features: Tensor
    ) -> tuple[Tensor, Tensor]:
        """No pair features, (B, M, channels) zeros, and the scores (B, M, L); the points play no part."""
        score = inner_products(source_features, target_features)
        return score.new_zeros(*score.shape[:2], self.channels), score


class RandomSignificance(nn.Module):
    """Instead of hard elimination by significance: a random choice, always the same for clouds of one size."""

    def forward(self, features: Tensor) -> Tensor:
        """Random scores (B, N) of features (B, N, K)."""
        generator = torch.Generator().manual_seed(0)
        return torch.rand(features.shape[:2], generator=generator).to(features)


def inner_products(source_features: Tensor, target_features: Tensor) -> Tensor:
    """Inner products (..., N, P) of features (..., N, K) and (..., P, K), over the root of their size."""
    scaled: Tensor = source_features @ target_features.transpose(-1, -2) / source_features.shape[-1] ** 0.5
    return scaled


class EqualValidity(nn.Module):
    """Instead of hybrid elimination: one validity for all matches, so that each has the same weight."""

    def forward(self, maximum: Tensor) -> Tensor:
        """Zero logits (B, M) from pair features' maxima (B, M, channels)."""
        return maximum.new_zeros(maximum.shape[:2])
