"""The learned features that do not change with the pose (:mod:`idam.describe.invariant`), to train.

What does not depend on weights, the surroundings and the pair features, is NumPy's; the layers are here once more, as
a module with gradients.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.describe.fpfh import BINS
from idam.describe.invariant import PERCENT, STRIDES, Surroundings, pair_features, surroundings

__all__ = ["LENGTH", "Invariant", "Message", "largest_message"]

PAIR_FEATURES = 5
LENGTH = 8.0
"""Length of the features at first: products of up to 64, over the root of 32, let a softmax choose among a thousand."""


class _LargestMessage(torch.autograd.Function):
    """See :func:`largest_message`."""

    @staticmethod
    def forward(ctx: Any, h: Tensor, weight: Tensor, near: Tensor, pairs: Tensor) -> Tensor:
        largest = torch.addmm(F.embedding(near[0], h), pairs[:, 0].t(), weight.t())
        learning = any(ctx.needs_input_grad)
        which = torch.zeros_like(largest, dtype=torch.uint8) if learning else None  # of the K
        for k in range(1, len(near)):
            message = torch.addmm(F.embedding(near[k], h), pairs[:, k].t(), weight.t())
            if which is not None:
                which.masked_fill_(message > largest, k)
            largest = torch.maximum(largest, message, out=largest)
        if learning:
            ctx.save_for_backward(which, near, pairs)
        return largest

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (gradient,), (which, near, pairs) = gradients, ctx.saved_tensors
        which = which.long()
        for_h = torch.zeros_like(gradient).scatter_add_(0, near.t().gather(1, which), gradient)
        for_weight = torch.stack([(x.t().gather(1, which) * gradient).sum(0) for x in pairs], 1)
        return for_h, for_weight, None, None


def largest_message(h: Tensor, weight: Tensor, near: Tensor, pairs: Tensor) -> Tensor:
    """max_j (h_j + weight g_ij) over the neighbours j of each point i, with no (K, N, C) tensor: (N, C).

    Args:
        h: (N, C).
        weight: (C, 5).
        near: rows of the neighbours, (K, N).
        pairs: their pair features g, (5, K, N), to which no gradient flows.
    """
    largest: Tensor = _LargestMessage.apply(h, weight, near, pairs)  # type: ignore[no-untyped-call] # torch's own
    return largest


class Message(nn.Module):
    """One layer: what each point takes from its neighbours."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.own = nn.Linear(channels, channels)
        self.other = nn.Linear(channels, channels, bias=False)
        self.pair = nn.Linear(PAIR_FEATURES, channels, bias=False)
        self.update = nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor, near: Tensor, pairs: Tensor) -> Tensor:
        """Features (N, C), rows of neighbours (K, N) and pair features (5, K, N) to features (N, C)."""
        largest = largest_message(self.other(x), self.pair.weight, near, pairs)
        updated: Tensor = F.relu(self.norm(x + self.update(F.relu(self.own(x) + largest))))
        return updated


class Invariant(nn.Module):
    """The features: vectors of one length, whose inner products say how alike the surroundings of two points are.

    Args:
        hidden: channels between the layers.
    """

    channels = 32
    rotation_invariant = True

    def __init__(self, hidden: int = 96) -> None:
        super().__init__()
        self.first = nn.Linear(3 * BINS, hidden)
        self.norm = nn.LayerNorm(hidden)
        self.layers = nn.ModuleList(Message(hidden) for _ in STRIDES)
        self.last = nn.Linear(hidden, self.channels)
        self.length = nn.Parameter(torch.tensor(LENGTH))

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, 32), without gradient in the points, of ``points`` (B, N, 3)."""
        clouds = points.detach().float().cpu().numpy()
        return torch.stack([self.describe(surroundings(cloud)) for cloud in clouds])

    def describe(self, around: Surroundings) -> Tensor:
        """Features (N, 32) of a cloud's points by their surroundings, where the weights are and in their dtype."""
        x = F.relu(self.norm(self.first(torch.from_numpy(around.histograms).to(self.length) / PERCENT)))
        for layer, near in zip(self.layers, around.near, strict=True):
            pairs = torch.from_numpy(pair_features(around.points, around.normals, near)).to(self.length)
            x = layer(x, torch.from_numpy(near).to(x.device, torch.long), pairs)
        return self.length * F.normalize(self.last(x), dim=-1)
