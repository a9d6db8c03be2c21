"""Weights that decay to nothing, and with them the optimiser's moments: to zero, not to denormal numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from idam.weights import SMALLEST

__all__ = ["flush_to_zero"]


def flush_to_zero(optimizer: torch.optim.Optimizer) -> None:
    """After each of the optimiser's steps, set to zero weights below 1e-12 in magnitude, and denormal moments.

    Nothing but weight decay moves the weights of a dead channel: they shrink by the same factor at each step, become
    denormal, which makes every product with them some hundred times as slow, and Adam's moments become so long before.
    """
    optimizer.register_step_post_hook(lambda optimizer, *_: _flush(optimizer))


@torch.no_grad()
def _flush(optimizer: torch.optim.Optimizer) -> None:
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            _clear(parameter, SMALLEST)
            for value in optimizer.state[parameter].values():
                if isinstance(value, Tensor) and value.shape == parameter.shape:
                    _clear(value, torch.finfo(value.dtype).tiny)


def _clear(values: Tensor, smallest: float) -> None:
    values.masked_fill_(values.abs() < smallest, 0)
