"""Learned point features by a graph neural network (appendix A).

    u_i(n+1) = f( max_{j in N_i} g( u_i(n) - u_j(n) ) ),    u(0) the coordinates

with N_i the K nearest neighbours of point i, fixed from the coordinates, g an MLP of two layers and f of one.

Most of the network's time and memory goes into the (points x neighbours) edges, so they are visited as few times as
can be: neighbours come first in memory, (K, P, C), which makes the maximum an elementwise one over K slabs; the first
layer of g, being linear, is applied to the points and not to their differences; and the ReLU of g, being monotonic,
comes after the maximum. The two autograd functions are the plain operations with a backward pass that does not
scatter. Without gradients, :mod:`idam.network.inference` needs fewer passes still.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.describe.neighbours import nearest_neighbours as nearest_by_tree
from idam.network.geometry import nearest_neighbours
from idam.network.inference import largest_messages, takes_plain_operations
from idam.network.layers import NormalisedLinear

__all__ = ["GNN", "EdgeLayer", "neighbour_graph", "neighbours_of"]


def neighbour_graph(points: Tensor, k: int) -> Tensor:
    """The k nearest neighbours of every point of a batch of clouds (B, N, 3), as edge layers take them.

    Returns:
        (k, P): rows of the flattened batch of P = B N points; each cloud is on its own.
    """
    return _flattened(neighbours_of(points, k))


def neighbours_of(points: Tensor, k: int) -> Tensor:
    """The k nearest others of every point of a batch of clouds (B, N, 3), by rows of each cloud: (B, N, k).

    By a tree or, on a GPU, by all distances, which stays there. A rigid motion leaves them as they are.
    """
    if points.is_cuda:
        return nearest_neighbours(points, k)
    clouds = points.detach().double().numpy()
    return torch.from_numpy(np.stack([nearest_by_tree(cloud, k)[1] for cloud in clouds]))


def _flattened(near: Tensor) -> Tensor:
    """Neighbours (B, N, k) by rows of each cloud as rows (k, B N) of the flattened batch."""
    batch, count, k = near.shape
    offset = torch.arange(batch, device=near.device).view(-1, 1, 1) * count
    return (near + offset).view(-1, k).t().contiguous()


class _NeighbourDifference(torch.autograd.Function):
    """See :func:`neighbour_difference`."""

    @staticmethod
    def forward(ctx: Any, centre: Tensor, h: Tensor, neighbours: Tensor) -> Tensor:
        ctx.save_for_backward(neighbours)
        ctx.points = len(h)
        return centre - F.embedding(neighbours, h)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        (gradient,) = gradients
        neighbours = ctx.saved_tensors[0].flatten()
        # the edges sorted by the neighbour they point to: one sum of a run for each point, and no scatter
        edges = torch.bincount(neighbours, minlength=ctx.points)
        as_neighbour = F.embedding_bag(
            neighbours.argsort(), gradient.flatten(0, 1), edges.cumsum(0) - edges, mode="sum"
        )
        return gradient.sum(0), -as_neighbour, None


class _NeighbourMaximum(torch.autograd.Function):
    """See :func:`neighbour_maximum`; of equal maxima, each receives the gradient."""

    @staticmethod
    def forward(ctx: Any, y: Tensor) -> Tensor:
        maximum = y.amax(0)
        ctx.save_for_backward(y, maximum)
        return maximum

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,) = gradients
        y, maximum = ctx.saved_tensors
        below = y - maximum
        # the gradient where `below` is zero: ReLU's own backward kernel is several times faster than a mask
        threshold = -torch.finfo(below.dtype).tiny
        passed: Tensor = torch.ops.aten.threshold_backward(gradient.expand_as(below), below, threshold)
        return passed


def neighbour_difference(centre: Tensor, h: Tensor, neighbours: Tensor) -> Tensor:
    """centre_i - h_j for every edge, (K, P, C), of (P, C) and (Q, C), whose rows the neighbours (K, P) are."""
    if not h.requires_grad:  # the same, of plain operations, which can be traced and exported
        return centre - F.embedding(neighbours, h)
    difference: Tensor = _NeighbourDifference.apply(centre, h, neighbours)  # type: ignore[no-untyped-call] # torch's own
    return difference


def neighbour_maximum(y: Tensor) -> Tensor:
    """The maximum over neighbours: (K, P, C) -> (P, C)."""
    if not y.requires_grad:
        return y.amax(0)
    maximum: Tensor = _NeighbourMaximum.apply(y)  # type: ignore[no-untyped-call] # torch's own
    return maximum


class EdgeLayer(nn.Module):
    """One round of message passing: f(max_j g(u_i - u_j)), (P, in) -> (P, out)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.first = NormalisedLinear(in_channels, out_channels)
        self.second = NormalisedLinear(out_channels, out_channels)
        self.update = NormalisedLinear(out_channels, out_channels)

    def forward(self, u: Tensor, neighbours: Tensor) -> Tensor:
        """Features (P, in) and neighbours (K, P) to features (P, out)."""
        weight, bias = self.first.projection()
        # in u's own precision, also under autocast: bfloat16 coordinates would not survive the difference
        with torch.autocast(u.device.type, enabled=False):
            h = F.linear(u, weight.to(u.dtype))
        centre = h if bias is None else h + bias
        if takes_plain_operations(self, u):
            edges = self.first.finish(neighbour_difference(centre, h, neighbours))
            messages = self.second.normalise(F.linear(edges, *self.second.projection()))
            largest = neighbour_maximum(messages)
        else:
            largest = largest_messages(centre, h, neighbours, self.second.folded())
        updated: Tensor = self.update(F.relu(largest))
        return updated


class GNN(nn.Module):
    """Five edge layers of 64 channels on the graph of the ``neighbours`` nearest points (appendix A)."""

    channels = 64
    rotation_invariant = False

    def __init__(self, neighbours: int = 12, layers: int = 5) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.layers = nn.ModuleList(EdgeLayer(3 if n == 0 else self.channels, self.channels) for n in range(layers))

    def graph(self, points: Tensor) -> Tensor:
        """Neighbours (B, N, K) of points (B, N, 3), N > K, by rows of each cloud.

        Raises:
            ValueError: the clouds have too few points for the graph.
        """
        if points.shape[1] <= self.neighbours:
            raise ValueError(f"a cloud of {points.shape[1]} points is too small: the GNN needs {self.neighbours + 1}")
        centred = points - points.mean(1, keepdim=True)
        return neighbours_of(centred.detach(), self.neighbours)

    def forward(self, points: Tensor, neighbours: Tensor | None = None) -> Tensor:
        """Features (B, N, 64) of points (B, N, 3), N > K; translation invariant, not rotation invariant.

        Args:
            points: (B, N, 3).
            neighbours: rows of the K nearest others of each point, (B, N, K), where they are known: then nothing is
                searched, and what is left can be traced and exported. None to search, by :meth:`graph`.

        Raises:
            ValueError: the clouds have too few points for the graph.
        """
        # neighbours and differences of coordinates need full precision also under autocast
        with torch.autocast(points.device.type, enabled=False):
            centred = points - points.mean(1, keepdim=True)
            near = _flattened(self.graph(points) if neighbours is None else neighbours)
        u = centred.flatten(0, 1)
        for layer in self.layers:
            u = layer(u, near)
        return u.view(*points.shape[:2], -1)
