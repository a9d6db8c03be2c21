"""Balanced sampling of training points (section 3.5).

In training, random points stand in for hard elimination: half of them with a match in the other cloud and half
without, so that matching, significance and validity all see both kinds.
"""

from __future__ import annotations

import torch
from torch import Tensor

from idam.network.geometry import nearest

__all__ = ["balanced_sample"]


def balanced_sample(
    aligned_source: Tensor, target: Tensor, count: int, radius: float, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Indices of ``count`` source points (B, M) and of the target points nearest to them (B, M).

    ceil(M/2) sources are drawn without replacement from p_pos(i) ~ [min_q |R* p_i + t* - q|^2 <= r^2] + 1e-6, the rest
    from p_neg(i) ~ [... > r^2] + 1e-6; each brings its nearest target point.

    Args:
        aligned_source: source points under the true transform, (B, N, 3).
        target: (B, P, 3).
        count: M.
        radius: r.
        generator: on the CPU; the draw is the same on every device.
    """
    distance, index = nearest(aligned_source, target)
    positive = (distance <= radius**2).to(torch.float32)
    positives = (count + 1) // 2
    chosen = torch.cat(
        [_draw(positive + 1e-6, positives, generator), _draw(1.0 - positive + 1e-6, count - positives, generator)], -1
    )
    return chosen, index.gather(-1, chosen)


def _draw(weight: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """``count`` draws without replacement by weight (B, N), as the top of log w + Gumbel noise."""
    uniform = torch.rand(weight.shape, generator=generator).clamp_(1e-20, 1 - 1e-7).to(weight.device)
    return (weight.log() - (-uniform.log()).log()).topk(count, dim=-1).indices
