"""The transformer that tells each cloud's features about the other's (Vaswani et al., NeurIPS 2017; DCP, 4.2)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["Attention", "Transformer"]


class Attention(nn.Module):
    """Scaled dot-product attention with several heads: queries (B, N, C) on a memory (B, M, C) -> (B, N, C)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.output = nn.Linear(channels, channels)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """What x gathers from the memory."""
        parts = (self.query(x), self.key(memory), self.value(memory))
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        gathered: Tensor = self.output(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(-2))
        return gathered


class Transformer(nn.Module):
    """One encoder block on the other cloud and one decoder block on a cloud's own features: what to add to these.

    LayerNorm, no dropout (DCP, section 5), no positions: the points carry them. Where the papers are silent,
    normalisation comes before each sublayer and once at the end of both blocks.
    """

    def __init__(self, channels: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.encoder = nn.ModuleList([Attention(channels, heads), mlp(channels, feed_forward)])
        self.decoder = nn.ModuleList(
            [Attention(channels, heads), Attention(channels, heads), mlp(channels, feed_forward)]
        )
        self.encoder_norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.decoder_norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(4))

    def forward(self, own: Tensor, other: Tensor) -> Tensor:
        """phi(own, other), (B, N, C) and (B, M, C) -> (B, N, C)."""
        memory = self.encode(other)
        attend, cross, feed = self.decoder
        first, second, third, last = self.decoder_norms
        normed = first(own)
        x = own + attend(normed, normed)
        x = x + cross(second(x), memory)
        x = x + feed(third(x))
        told: Tensor = last(x)
        return told

    def encode(self, x: Tensor) -> Tensor:
        """What the decoder attends to."""
        attend, feed = self.encoder
        first, second, last = self.encoder_norms
        normed = first(x)
        x = x + attend(normed, normed)
        x = x + feed(second(x))
        memory: Tensor = last(x)
        return memory


def mlp(channels: int, hidden: int) -> nn.Sequential:
    """The feed-forward part of a block."""
    return nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels))
