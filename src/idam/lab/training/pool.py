"""Pairs drawn once and kept with their features, where these are not trained: steps cost what matching them costs."""

from __future__ import annotations

import torch

from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.pairs import Pairs
from idam.lab.training.batches import Batch, draw_pairs, generator_at, rows_at, sampled
from idam.lab.training.recipe import Recipe
from idam.network.model import IDAM

__all__ = ["Pool"]

DRAW = -1
"""The step whose generator draws the pairs; the steps of the training draw their samples."""
AT_ONCE = 50
"""Pairs that are given their features together."""


class Pool:
    """A recipe's pool of pairs, with the features that a network gives them as it is now.

    Args:
        shapes: whole shapes, each for one pair in turn.
        recipe: with a pool.
        network: whose features to keep.
    """

    def __init__(self, shapes: Shapes, recipe: Recipe, network: IDAM) -> None:
        assert recipe.pool is not None
        self.recipe = recipe
        self.pairs = draw_pairs(
            shapes.points[torch.arange(recipe.pool) % len(shapes)], recipe, generator_at(recipe, DRAW)
        )
        self.features = _features(network, self.pairs)

    def __len__(self) -> int:
        return len(self.pairs)

    def batch(self, step: int, rank: int, world: int) -> Batch:
        """The pairs, samples and features of one process at one step."""
        rows = rows_at(len(self), self.recipe, step)[rank::world]
        batch = sampled(self.pairs[rows], self.recipe, generator_at(self.recipe, step, rank))
        source, target = self.features
        return batch._replace(features=(source[rows], target[rows]))


@torch.no_grad()
def _features(network: IDAM, pairs: Pairs) -> tuple[torch.Tensor, torch.Tensor]:
    """Features (B, N, K) and (B, P, K) of both sides, as after training."""
    was_training = network.training
    network.eval()
    parts = [pairs[start : start + AT_ONCE] for start in range(0, len(pairs), AT_ONCE)]
    source, target = zip(*(network.encode(part.source, part.target) for part in parts), strict=True)
    network.train(was_training)
    return torch.cat(source), torch.cat(target)
