"""Learned features that do not change with the cloud's pose: FPFH, and messages from ever farther around.

Each point starts from its histograms (FPFH) and gathers, layer by layer, the largest of its neighbours' messages,

    x_i  <-  ReLU(norm(x_i + W ReLU(A x_i + max_j (B x_j + C g_ij)))),

where the pair features g_ij = (|d|, n_i . d, n_j . d, n_i . n_j, det(d, n_i, n_j)), d from p_i to p_j and n the
normals, say how two oriented points lie to each other, in any pose (after Drost et al., "Model Globally, Match
Locally", CVPR 2010, and Deng, Birdal and Ilic, "PPFNet", CVPR 2018). The first layer's neighbours are the nearest 16;
the next two take 16 of the nearest 48 and 128, so that a few layers see far. Distances are in spacings of the cloud:
neither its scale nor its density matters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.network.features.fpfh import BINS, fpfh_of_neighbours
from idam.network.features.normals import (
    Reach,
    among_nearest,
    nearest_neighbours_of,
    normal_reach,
    normals_from_neighbours,
)

__all__ = ["Invariant", "Surroundings", "largest_message", "pair_features", "surroundings"]

NORMALS = normal_reach(2.5, 30)
"""Whom a normal is taken from: those within 2.5 spacings."""
HISTOGRAMS = Reach(6.0, at_most=99)
"""Whom a histogram counts: those within 6 spacings."""
NEIGHBOURS = 16
"""Whose messages a point gathers in each layer."""
STRIDES = (1, 3, 8)
"""Each layer's neighbours: every so many-th of the nearest."""
FAR = 8.0
"""Spacings that count as a distance of one."""
PAIR_FEATURES = 5
LENGTH = 8.0
"""Length of the features at first: products of up to 64, over the root of 32, let a softmax choose among a thousand."""
PERCENT = 20.0
"""FPFH's percentages are divided by it: about unit size."""


class Surroundings(NamedTuple):
    """What :class:`Invariant` sees of a cloud of N points: all that does not depend on weights.

    Attributes:
        points: (N, 3), in spacings.
        normals: (N, 3).
        histograms: FPFH (N, 33).
        near: rows of each layer's neighbours, (layers, K, N).
    """

    points: Tensor
    normals: Tensor
    histograms: Tensor
    near: Tensor


@torch.no_grad()
def surroundings(points: Tensor, spacing: float | None = None) -> Surroundings:
    """The surroundings of a cloud's points.

    Args:
        points: (N, 3), of any scale.
        spacing: distance of a point to its nearest neighbour; None for the median of this cloud.
    """
    points = points - points.mean(0)
    distance, near = nearest_neighbours_of(points, NEIGHBOURS * STRIDES[-1])
    if spacing is None:
        apart = distance[:, 0][distance[:, 0] > 0]
        spacing = float(apart.median()) if len(apart) else 1.0
    cloud, distance = (points / spacing)[None], distance / spacing
    normals = normals_from_neighbours(cloud, among_nearest(distance, near, NORMALS))
    histograms = fpfh_of_neighbours(cloud, normals, among_nearest(distance, near, HISTOGRAMS))
    last = near.shape[1] - 1
    layers = [near[:, torch.arange(s - 1, NEIGHBOURS * s, s).clamp_max(last)].t() for s in STRIDES]
    return Surroundings(cloud[0], normals[0], histograms[0], torch.stack(layers))


def pair_features(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """How oriented points (N, 3) and their neighbours, rows (K, N), lie to each other: (K, N, 5)."""
    offset = points[near] - points
    distance = offset.norm(dim=-1, keepdim=True)
    direction = offset / distance.clamp_min(torch.finfo(points.dtype).eps)
    theirs = normals[near]
    angles = [(direction * normals).sum(-1), (direction * theirs).sum(-1), (normals * theirs).sum(-1)]
    turn = (torch.linalg.cross(normals.expand_as(theirs), theirs) * direction).sum(-1)
    return torch.cat([distance / FAR, torch.stack([*angles, turn], -1)], -1)


class _LargestMessage(torch.autograd.Function):
    """See :func:`largest_message`."""

    @staticmethod
    def forward(ctx: Any, h: Tensor, weight: Tensor, near: Tensor, pairs: Tensor) -> Tensor:
        largest = torch.addmm(F.embedding(near[0], h), pairs[0], weight.t())
        learning = any(ctx.needs_input_grad)
        which = torch.zeros_like(largest, dtype=torch.uint8) if learning else None  # of the K
        for k in range(1, len(near)):
            message = torch.addmm(F.embedding(near[k], h), pairs[k], weight.t())
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
        for_weight = torch.stack([(x.t().gather(1, which) * gradient).sum(0) for x in pairs.unbind(-1)], 1)
        return for_h, for_weight, None, None


def largest_message(h: Tensor, weight: Tensor, near: Tensor, pairs: Tensor) -> Tensor:
    """max_j (h_j + weight g_ij) over the neighbours j of each point i, with no (K, N, C) tensor: (N, C).

    Args:
        h: (N, C).
        weight: (C, 5).
        near: rows of the neighbours, (K, N).
        pairs: their pair features g, (K, N, 5), to which no gradient flows.
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
        """Features (N, C), rows of neighbours (K, N) and pair features (K, N, 5) to features (N, C)."""
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
        """Features (B, N, 32) of ``points`` (B, N, 3)."""
        return torch.stack([self.describe(surroundings(cloud)) for cloud in points.float()])

    def describe(self, around: Surroundings) -> Tensor:
        """Features (N, 32) of a cloud's points by their surroundings."""
        x = F.relu(self.norm(self.first(around.histograms / PERCENT)))
        for layer, near in zip(self.layers, around.near, strict=True):
            x = layer(x, near, pair_features(around.points, around.normals, near))
        return self.length * F.normalize(self.last(x), dim=-1)
