"""The pairs of each step, and those that pick the checkpoint."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.pairs import EXPERIMENTS, Pairs, fixed_pairs, make_pairs
from idam.lab.data.practice import make_practice_pairs
from idam.lab.training.recipe import Recipe
from idam.network.elimination import share_of
from idam.network.geometry import apply_transform
from idam.network.sampling import balanced_sample

__all__ = ["Batch", "batch_at", "draw_pairs", "generator_at", "pairs_at", "rows_at", "sampled", "split_validation"]

VALIDATION_SHAPES = 200
VALIDATION_SEED = 7


class Batch(NamedTuple):
    """Pairs (:class:`idam.lab.data.pairs.Pairs`) and the rows (B, M) of each cloud that balanced sampling drew.

    With both clouds' features, (B, N, K) and (B, P, K), where these are known (:class:`idam.lab.training.pool.Pool`).
    """

    source: Tensor
    target: Tensor
    rotation: Tensor
    translation: Tensor
    source_index: Tensor
    target_index: Tensor
    features: tuple[Tensor, Tensor] | None = None


def split_validation(shapes: Shapes, recipe: Recipe) -> tuple[Shapes, Pairs]:
    """Shapes to train on, and fixed pairs of the 200 others (a tenth, where there are few) that pick the checkpoint."""
    order = torch.randperm(len(shapes), generator=torch.Generator().manual_seed(recipe.seed))
    held = min(VALIDATION_SHAPES, max(1, len(shapes) // 10))
    train = Shapes(shapes.points[order[held:]], shapes.labels[order[held:]])
    points = shapes.points[order[:held]]
    if recipe.experiment in EXPERIMENTS:
        return train, fixed_pairs(points, VALIDATION_SEED, recipe.sigma)
    return train, draw_pairs(points, recipe, torch.Generator().manual_seed(VALIDATION_SEED))


def draw_pairs(points: Tensor, recipe: Recipe, generator: torch.Generator) -> Pairs:
    """Pairs of whole shapes (B, N, 3) to train on."""
    if recipe.experiment == "practice":
        return make_practice_pairs(points, generator)
    if recipe.experiment == "practice-any-rotation":
        return make_practice_pairs(points, generator, recipe.max_angle)
    return make_pairs(points, generator, recipe.sigma)


def batch_at(shapes: Shapes, recipe: Recipe, step: int, rank: int, world: int) -> Batch:
    """The pairs and sampled points of one process at one step, a function of the seed and the step alone."""
    generator = generator_at(recipe, step, rank)
    return sampled(pairs_at(shapes, recipe, step, generator, rank, world), recipe, generator)


def sampled(pairs: Pairs, recipe: Recipe, generator: torch.Generator) -> Batch:
    """Pairs with the rows that balanced sampling draws of them."""
    aligned = apply_transform(pairs.source, pairs.rotation, pairs.translation)
    count = share_of(pairs.source.shape[1], recipe.keep)
    source_index, target_index = balanced_sample(aligned, pairs.target, count, recipe.radius, generator)
    return Batch(pairs.source, pairs.target, pairs.rotation, pairs.translation, source_index, target_index)


def generator_at(recipe: Recipe, step: int, rank: int = 0) -> torch.Generator:
    """What all that is random about one process's step is drawn from, the pairs first."""
    return torch.Generator().manual_seed((recipe.seed * 1_000_003 + step) * 4099 + rank)


def pairs_at(
    shapes: Shapes, recipe: Recipe, step: int, generator: torch.Generator, rank: int = 0, world: int = 1
) -> Pairs:
    """The pairs of one process at one step, drawn from its generator."""
    rows = rows_at(len(shapes), recipe, step)[rank::world]
    return draw_pairs(shapes.points[rows], recipe, generator)


def rows_at(size: int, recipe: Recipe, step: int) -> Tensor:
    """Which of so many rows make up a step's batch: all in turn, in an order of its own in each epoch."""
    epoch, position = divmod(step, size // recipe.batch_size)
    order = torch.randperm(size, generator=torch.Generator().manual_seed(recipe.seed * 1009 + epoch))
    return order[position * recipe.batch_size : (position + 1) * recipe.batch_size]
