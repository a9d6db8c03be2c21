"""Distance-aware similarity matrix convolution (section 3.2).

For every pair of a source point p_i and a target point q_j, the vector (equation 2)

    T(i, j) = [ u_S(i) ; u_T(j) ; |p_i - q_j| ; (p_i - q_j) / |p_i - q_j| ]        (2K + 4 channels)

goes through 1x1 convolutions to pair features F(i, j), and these to one score; a softmax over each row of scores is
the similarity matrix. The first convolution is a linear map of a concatenation, hence the sum of one map for each
part: T is never built. :mod:`idam.network.inference` does the same in less time where no gradient is asked for.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.network.inference import score_pairs, takes_plain_operations
from idam.network.layers import NormalisedLinear

__all__ = ["SimilarityConvolution", "pair_geometry"]


def pair_geometry(source: Tensor, target: Tensor) -> Tensor:
    """Distance and direction (B, M, L, 4) of every pair of source (B, M, 3) and target (B, L, 3) points.

    The direction of coincident points is zero.
    """
    offset = source.unsqueeze(2) - target.unsqueeze(1)
    distance = offset.norm(dim=-1, keepdim=True)
    return torch.cat([distance, offset / distance.clamp_min(torch.finfo(offset.dtype).eps)], -1)


class SimilarityConvolution(nn.Module):
    """A learned score for every pair from both points' features, their distance and direction."""

    def __init__(self, feature_channels: int, channels: int) -> None:
        super().__init__()
        self.feature_channels = feature_channels
        self.first = NormalisedLinear(2 * feature_channels + 4, channels)
        self.hidden = nn.ModuleList(NormalisedLinear(channels, channels) for _ in range(2))
        self.score = nn.Linear(channels, 1)

    def forward(
        self, source: Tensor, target: Tensor, source_features: Tensor, target_features: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Each source point's maximum of pair features, (B, M, channels), and the scores (B, M, L) before the softmax.

        Args:
            source: points (B, M, 3).
            target: points (B, L, 3).
            source_features: (B, M, K).
            target_features: (B, L, K).
        """
        clouds = source, target, source_features, target_features
        if takes_plain_operations(self, *clouds):
            pairs = self.pair_features(*clouds)
            return pairs.amax(2), self.score(pairs).squeeze(-1)
        layers = [layer.folded() for layer in (self.first, *self.hidden)]
        return score_pairs([*layers, (self.score.weight, self.score.bias)], *clouds)

    def pair_features(self, source: Tensor, target: Tensor, source_features: Tensor, target_features: Tensor) -> Tensor:
        """F(i, j), (B, M, L, channels), of every pair; the arguments are those of :meth:`forward`."""
        weight, bias = self.first.projection()
        k = self.feature_channels
        for_source, for_target, for_geometry = weight[:, :k], weight[:, k : 2 * k], weight[:, 2 * k :]
        with torch.autocast(source.device.type, enabled=False):
            geometry = pair_geometry(source, target)
        pairs = F.linear(geometry, for_geometry, bias)
        pairs += F.linear(source_features, for_source).unsqueeze(2)
        pairs += F.linear(target_features, for_target).unsqueeze(1)
        pairs = self.first.finish(pairs)
        for layer in self.hidden:
            pairs = layer(pairs)
        return pairs
