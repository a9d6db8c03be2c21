"""Point features by edge convolutions (Wang et al., "Dynamic Graph CNN", TOG 2019), as DCP and PRNet use them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.network.features.gnn import neighbour_graph

__all__ = ["DGCNN", "EdgeConv", "largest_neighbour"]


class _LargestNeighbour(torch.autograd.Function):
    """See :func:`largest_neighbour`."""

    @staticmethod
    def forward(ctx: Any, h: Tensor, neighbours: Tensor) -> Tensor:
        largest = F.embedding(neighbours[0], h)
        which = torch.zeros_like(largest, dtype=torch.int16)  # of the K: a quarter of the memory of the point's index
        for k, row in enumerate(neighbours[1:], 1):
            candidate = F.embedding(row, h)
            which.masked_fill_(candidate > largest, k)
            largest = torch.maximum(largest, candidate, out=largest)
        ctx.save_for_backward(which, neighbours)
        return largest

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,), (which, neighbours) = gradients, ctx.saved_tensors
        points = neighbours.t().gather(1, which.long())
        return torch.zeros_like(gradient).scatter_add_(0, points, gradient), None


def largest_neighbour(h: Tensor, neighbours: Tensor) -> Tensor:
    """max_j h_j over the neighbours j of each point: (P, C), graph (K, P) -> (P, C), with no (K, P, C) tensor."""
    largest: Tensor = _LargestNeighbour.apply(h, neighbours)  # type: ignore[no-untyped-call] # torch's own
    return largest


class EdgeConv(nn.Module):
    """ReLU(norm(max_j h(x_i, x_j - x_i))), (P, in) -> (P, out), h linear (DCP, section 4.1).

    h is A x_i + B (x_j - x_i), so that its maximum over j is (A - B) x_i + max_j B x_j: two maps of the points, none
    of the edges. Normalisation and ReLU come after the maximum, with which they commute but for a negative scale and
    the statistics, which are those of the maxima.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.centre = nn.Linear(in_channels, out_channels, bias=False)
        self.difference = nn.Linear(in_channels, out_channels, bias=False)
        self.norm = nn.BatchNorm1d(out_channels)

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """Features (P, in) and neighbours (K, P) to features (P, out)."""
        h = self.difference(x)
        return F.relu(self.norm(self.centre(x) - h + largest_neighbour(h, neighbours)))


class DGCNN(nn.Module):
    """Edge convolutions one after the other on the graph of the nearest points (DCP, section 4.1).

    The papers do not say whether the graph is built anew from each layer's features: here it is of the coordinates
    throughout, which lets rigid moves share it. The last layer's output is the feature, as written.
    """

    def __init__(self, neighbours: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.layers = nn.ModuleList(EdgeConv(i, o) for i, o in pairwise((3, *widths)))

    def graph(self, points: Tensor) -> Tensor:
        """The graph (K, B N) of points (B, N, 3), N > ``neighbours``; moving the points leaves it as it is.

        Raises:
            ValueError: the clouds have too few points.
        """
        if points.shape[1] <= self.neighbours:
            raise ValueError(f"a cloud of {points.shape[1]} points is too small: {self.neighbours + 1} are needed")
        return neighbour_graph(points - points.mean(1, keepdim=True), self.neighbours)

    def forward(self, points: Tensor, graph: Tensor) -> Tensor:
        """Features (B, N, C) of points (B, N, 3) with their graph (K, B N)."""
        x = points.flatten(0, 1)
        for layer in self.layers:
            x = layer(x, graph)
        return x.view(*points.shape[:2], -1)
