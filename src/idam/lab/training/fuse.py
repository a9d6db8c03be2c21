"""Fusing what a training step spends most of its time in."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from idam.network.model import IDAM

__all__ = ["fuse_convolutions"]


def fuse_convolutions(network: IDAM) -> None:
    """Let ``torch.compile`` fuse the similarity convolutions, in training alone; it needs a C++ compiler.

    Their (points x points) features go through memory once a layer then: 0.15 s forward and backward for 16 pairs of
    128 points instead of 0.28 (bfloat16, one core of an Intel Xeon). Compiling takes some 20 seconds.
    """
    for layer in network.similarity:
        plain, fused = layer.forward, torch.compile(layer.forward, dynamic=False)
        layer.forward = _in_training(layer, fused, plain)


def _in_training(layer: nn.Module, fused: Any, plain: Any) -> Any:
    return lambda *clouds: (fused if layer.training else plain)(*clouds)
