"""Learned point features by a graph neural network (appendix A).

    u_i(n+1) = f( max_{j in N_i} g( u_i(n) - u_j(n) ) ),    u(0) the coordinates

with N_i the K nearest neighbours of point i, fixed from the coordinates, g an MLP of two layers and f of one.

Most of the network's time and memory goes into the (points x neighbours) edges, so they are visited as few times as
can be: neighbours come first in memory, (K, P, C), which makes the maximum an elementwise one over K slabs; the first
layer of g, being linear, is applied to the points and not to their differences; and the ReLU of g, being monotonic,
comes after the maximum. The two autograd functions are the plain operations with a backward pass that does not
scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.geometry import nearest_neighbours
from idam.network.layers import NormalisedLinear

__all__ = ["GNN", "Graph"]


@dataclass(frozen=True)
class Graph:
    """The neighbours of every point of a batch, by row number in the flattened batch of P = B N points.

    Attributes:
        neighbours: (K, P), the neighbours of each point.
        order: (K P,), the edges sorted by the neighbour they point to.
        start: (P,), where each neighbour's edges begin in ``order``.
    """

    neighbours: Tensor
    order: Tensor
    start: Tensor

    @classmethod
    def build(cls, points: Tensor, k: int) -> Graph:
        """The k-nearest-neighbour graph of points (B, N, 3), each cloud on its own."""
        batch, count, _ = points.shape
        offset = torch.arange(batch, device=points.device).view(-1, 1, 1) * count
        neighbours = (nearest_neighbours(points, k) + offset).view(-1, k).t().contiguous()
        flat = neighbours.flatten()
        edges = torch.bincount(flat, minlength=batch * count)
        return cls(neighbours, flat.argsort(), edges.cumsum(0) - edges)


class _NeighbourDifference(torch.autograd.Function):
    """See :func:`neighbour_difference`."""

    @staticmethod
    def forward(ctx: Any, h: Tensor, neighbours: Tensor, order: Tensor, start: Tensor) -> Tensor:
        ctx.save_for_backward(order, start)
        return h - F.embedding(neighbours, h)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = gradients
        order, start = ctx.saved_tensors
        as_centre = gradient.sum(0)
        as_neighbour = F.embedding_bag(order, gradient.flatten(0, 1), start, mode="sum")
        return as_centre - as_neighbour, None, None, None


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


def neighbour_difference(h: Tensor, graph: Graph) -> Tensor:
    """h_i - h_j for every edge of the graph: (P, C) -> (K, P, C)."""
    difference: Tensor = _NeighbourDifference.apply(  # type: ignore[no-untyped-call] # torch leaves apply untyped
        h, graph.neighbours, graph.order, graph.start
    )
    return difference


def neighbour_maximum(y: Tensor) -> Tensor:
    """The maximum over neighbours: (K, P, C) -> (P, C)."""
    maximum: Tensor = _NeighbourMaximum.apply(y)  # type: ignore[no-untyped-call] # torch leaves apply untyped
    return maximum


class EdgeLayer(nn.Module):
    """One round of message passing: f(max_j g(u_i - u_j)), (P, in) -> (P, out)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.first = NormalisedLinear(in_channels, out_channels)
        self.second = NormalisedLinear(out_channels, out_channels)
        self.update = NormalisedLinear(out_channels, out_channels)

    def forward(self, u: Tensor, graph: Graph) -> Tensor:
        """Features (P, in) and their graph to features (P, out)."""
        weight, bias = self.first.projection()
        # in u's own precision, also under autocast: bfloat16 coordinates would not survive the difference
        with torch.autocast(u.device.type, enabled=False):
            h = F.linear(u, weight.to(u.dtype))
        difference = neighbour_difference(h, graph)
        edges = self.first.finish(difference if bias is None else difference + bias)
        edges = self.second.normalise(F.linear(edges, *self.second.projection()))
        updated: Tensor = self.update(F.relu(neighbour_maximum(edges)))
        return updated


class GNN(nn.Module):
    """Five edge layers of 64 channels on the graph of the ``neighbours`` nearest points (appendix A)."""

    channels = 64

    def __init__(self, neighbours: int = 12, layers: int = 5) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.layers = nn.ModuleList(EdgeLayer(3 if n == 0 else self.channels, self.channels) for n in range(layers))

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, 64) of points (B, N, 3), N > ``neighbours``; translation invariant, not rotation invariant.

        Raises:
            ValueError: the clouds have too few points for the graph.
        """
        if points.shape[1] <= self.neighbours:
            raise ValueError(f"a cloud of {points.shape[1]} points is too small: the GNN needs {self.neighbours + 1}")
        # neighbours and differences of coordinates need full precision also under autocast
        with torch.autocast(points.device.type, enabled=False):
            centred = points - points.mean(1, keepdim=True)
            graph = Graph.build(centred.detach(), self.neighbours)
        u = centred.flatten(0, 1)
        for layer in self.layers:
            u = layer(u, graph)
        return u.view(*points.shape[:2], -1)
