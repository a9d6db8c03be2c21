"""The one building block of the network: a linear map, batch normalisation, ReLU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["NormalisedLinear"]


class NormalisedLinear(nn.Module):
    """A 1x1 convolution over the last axis, then batch normalisation and ReLU: (..., in) -> (..., out).

    In training the statistics are those of the batch, over all leading axes. In evaluation the normalisation is folded
    into the linear map, which leaves one pass over the data.

    The halves :meth:`projection` and :meth:`finish` are public for callers whose input is a sum of parts: the linear
    map of the sum is the sum of the parts' maps, so that no part is ever repeated for each pair of points.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels, out_channels, bias=False)
        self.norm = nn.BatchNorm1d(out_channels)

    def projection(self) -> tuple[Tensor, Tensor | None]:
        """Weight (out, in) and bias (out,) to apply; the bias is None in training, where the norm comes after."""
        return (self.linear.weight, None) if self.training else self.folded()

    def folded(self) -> tuple[Tensor, Tensor]:
        """Weight (out, in) and bias (out,) of the linear map and the normalisation by running statistics as one."""
        assert self.norm.running_var is not None and self.norm.running_mean is not None
        scale = self.norm.weight * torch.rsqrt(self.norm.running_var + self.norm.eps)
        return self.linear.weight * scale.unsqueeze(1), self.norm.bias - self.norm.running_mean * scale

    def normalise(self, x: Tensor) -> Tensor:
        """Batch normalisation of the projected input (..., out), where :meth:`projection` has not done it already."""
        return self.norm(x.flatten(0, -2)).view(x.shape) if self.training else x

    def finish(self, x: Tensor) -> Tensor:
        """What follows the projection (..., out); it may overwrite ``x``."""
        return F.relu(self.normalise(x), inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        """Project, normalise, rectify."""
        return self.finish(F.linear(x, *self.projection()))
