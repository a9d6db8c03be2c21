"""The network's two large tensors in evaluation: the edges of the GNN, and the pairs of points.

Both cost memory traffic more than arithmetic. So they go through in blocks that stay in the cache, into buffers that
are used again, in as few passes as can be. What saves passes:

- relu(z + b) = max(z, -b) + b: the bias before a ReLU is a floor, and the one after it goes into the next layer's bias.
- relu(c - h) = c - min(c, h): a difference and a ReLU are one pass, and W c is known for each point.
- What all pairs of a row have in common is a bias of that row.

Layers are weights and biases with the normalisation folded in. Buffers have no gradient: where one may be asked for,
the modules take plain operations, which are closer to the paper's formulas.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor, nn

__all__ = ["Layer", "largest_messages", "score_pairs", "takes_plain_operations"]

Layer = tuple[Tensor, Tensor]
"""Weight (out, in) and bias (out,)."""

POINTS_IN_CACHE = 128
"""Points whose edges go through a layer at once: their features, 0.4 MB, stay near the core."""
PAIRS_IN_CACHE = 8192
"""Pairs that go through the convolutions at once: their features, 1 MB, stay near the core."""


def takes_plain_operations(module: nn.Module, *inputs: Tensor) -> bool:
    """Whether a module is in training or under autocast, or may be asked for a gradient."""
    return (
        module.training
        or torch.is_autocast_enabled(inputs[0].device.type)
        or (torch.is_grad_enabled() and any(x.requires_grad for x in (*inputs, *module.parameters())))
    )


def largest_messages(centre: Tensor, h: Tensor, neighbours: Tensor, layer: Layer) -> Tensor:
    """max_j (W relu(c_i - h_j) + b) over the neighbours j of each point i: (P, out).

    Args:
        centre: c, (P, C).
        h: (P, C).
        neighbours: rows of h, (K, P).
        layer: W and b.
    """
    weight, bias = layer
    largest = torch.addmm(bias, centre, weight.t())
    points = len(centre) if centre.is_cuda else min(POINTS_IN_CACHE, len(centre))
    edges, messages = (centre.new_empty(len(neighbours) * points, size) for size in reversed(weight.shape))
    for some, own, near in zip(
        torch.split(largest, points), torch.split(centre, points), torch.split(neighbours, points, 1), strict=True
    ):
        gathered, product = edges[: near.numel()], messages[: near.numel()]
        torch.index_select(h, 0, near.flatten(), out=gathered)
        gathered.view(*near.shape, -1).clamp_max_(own)
        torch.mm(gathered, weight.t(), out=product)
        some -= product.view(*near.shape, -1).amin(0)
    return largest


def score_pairs(
    layers: Sequence[Layer], source: Tensor, target: Tensor, source_features: Tensor, target_features: Tensor
) -> tuple[Tensor, Tensor]:
    """The maximum of each row's pair features, (B, M, C), and the scores (B, M, L), from equation 2 on.

    Args:
        layers: that of equation 2's channels, those of the pair features, and that of the score.
        source: points (B, M, 3).
        target: points (B, L, 3).
        source_features: (B, M, K).
        target_features: (B, L, K).
    """
    # channels first, (C, B, M, L): every pass is along many pairs
    source, target, source_features, target_features = (
        x.permute(2, 0, 1) for x in (source, target, source_features, target_features)
    )
    (weight, bias), *hidden, score = layers
    of_source, of_target, of_geometry = torch.split(weight, [len(source_features), len(target_features), 4], 1)
    column = _project(of_target, target_features).unsqueeze(2)
    row = [_project(of_source, source_features, bias)]
    for layer in (*hidden, score):
        row.append(_project(layer[0], row[-1], layer[1]))
    floors = [-part.unsqueeze(-1) for part in row[:-1]]

    (_, batch, count), width, channels = source.shape, target.shape[2], len(weight)
    at_once = count if source.is_cuda else min(count, max(1, PAIRS_IN_CACHE // (batch * width)))
    buffers = [source.new_empty(size, batch * at_once * width) for size in (4, channels, channels)]
    maximum, scores = torch.empty_like(row[0]), source.new_empty(batch, count, width)
    for start in range(0, count, at_once):
        some = slice(start, min(start + at_once, count))
        shape = (batch, some.stop - start, width)
        geometry, x, y = (buffer[:, : prod(shape)] for buffer in buffers)
        _pair_geometry(source[:, :, some].unsqueeze(3), target.unsqueeze(2), geometry.view(-1, *shape))
        torch.mm(of_geometry, geometry, out=x)
        x.view(-1, *shape).add_(column).clamp_min_(floors[0][:, :, some])
        for (weight, _), floor in zip(hidden, floors[1:], strict=True):
            torch.mm(weight, x, out=y)
            y.view(-1, *shape).clamp_min_(floor[:, :, some])
            x, y = y, x
        maximum[:, :, some] = x.view(-1, *shape).amax(-1)
        scores[:, some] = torch.mm(score[0], x).view(shape)
    return maximum.add_(row[-2]).permute(1, 2, 0), scores.add_(row[-1].squeeze(0).unsqueeze(-1))


def _project(weight: Tensor, x: Tensor, bias: Tensor | None = None) -> Tensor:
    """A layer along the first axis: (in, B, N) to (out, B, N)."""
    projected: Tensor = torch.tensordot(weight, x, 1)
    return projected if bias is None else projected.add_(bias.view(-1, 1, 1))


def _pair_geometry(source: Tensor, target: Tensor, out: Tensor) -> None:
    """Distance and direction (4, B, M, L) of points (3, B, M, 1) and (3, B, 1, L); zero for coincident points."""
    distance, offset = out[0], out[1:]
    x, y, z = torch.sub(source, target, out=offset)
    torch.mul(x, x, out=distance).addcmul_(y, y).addcmul_(z, z).sqrt_()
    offset.div_(distance.clamp_min(torch.finfo(out.dtype).eps))
