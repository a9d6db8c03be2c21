"""Two-stage point elimination (section 3.3): hard, before matching, and hybrid, within every iteration."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from idam.network.layers import NormalisedLinear

__all__ = ["Significance", "Validity", "hybrid_weights", "keep_most_significant", "share_of"]


class Significance(nn.Module):
    """The significance score s(i) of each point from its own feature (section 3.3.1): (B, N, K) -> (B, N).

    Trained to be the negative entropy of the point's row of the similarity matrix: high where matching it is easy.
    """

    def __init__(self, feature_channels: int, channels: int) -> None:
        super().__init__()
        score = nn.Linear(channels, 1)
        # start at the negative entropy of a uniform row of 128 points, so that learning that constant, a large error
        # at first, does not shape the features
        nn.init.constant_(score.bias, -math.log(128))
        self.mlp = nn.Sequential(
            NormalisedLinear(feature_channels, channels), NormalisedLinear(channels, channels), score
        )

    def forward(self, features: Tensor) -> Tensor:
        """Scores (B, N) of features (B, N, K)."""
        scores: Tensor = self.mlp(features)
        return scores.squeeze(-1)


def keep_most_significant(significance: Tensor, keep: float) -> Tensor:
    """Hard elimination: indices (B, M) of the M = ceil(keep N) points of highest significance (B, N) (section 3.3.1).

    Never fewer than three points, which a rigid transform needs.
    """
    count = significance.shape[-1]
    return significance.topk(min(count, max(3, share_of(count, keep))), dim=-1).indices


def share_of(count: int, share: float) -> int:
    """ceil(share count), exact where the product is an integer up to rounding, as it is for N / 6."""
    return math.ceil(share * count - 1e-9)


class Validity(nn.Module):
    """The validity of each match from its row of pair features (section 3.3.2): sigmoid(f(max_j F(i, j)))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(NormalisedLinear(channels, channels), nn.Linear(channels, 1))

    def forward(self, maximum: Tensor) -> Tensor:
        """Logits (B, M) of the validity from the maximum of each point's pair features, (B, M, channels)."""
        logits: Tensor = self.mlp(maximum)
        return logits.squeeze(-1)


def hybrid_weights(validity: Tensor, keep: float) -> Tensor:
    """Hybrid elimination: w_i = v(i) [v(i) >= quantile], normalised to sum 1 (section 3.3.2, equation 7).

    Args:
        validity: v (B, M) in [0, 1].
        keep: share of matches that stay; 0.5 is the paper's median cut.
    """
    threshold = validity.quantile(1.0 - keep, dim=-1, keepdim=True, interpolation="lower")
    weight = torch.where(validity >= threshold, validity, 0.0)
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
