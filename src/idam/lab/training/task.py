"""What a training is of: the pairs of each step, the module that turns them into a loss, and how it is validated."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from idam.lab.data.modelnet40 import experiment_shapes
from idam.lab.data.pairs import Pairs
from idam.lab.evaluation.metrics import Metrics, measure
from idam.lab.training.batches import Batch, batch_at, split_validation
from idam.lab.training.checkpoint import Origin, Scores, initial_model
from idam.lab.training.pool import Pool
from idam.lab.training.recipe import Recipe
from idam.lab.training.step import SupervisedStep

__all__ = ["PairTask", "Task", "validate"]


class Task(Origin, Protocol):
    """What the training loop needs to know.

    Attributes:
        module: from a batch to its loss; ``module.model`` is the network.
        size: pairs of an epoch.
    """

    module: Any
    size: int

    def batch(self, step: int, rank: int, world: int) -> Any:
        """The pairs of one process at one step."""

    def validate(self) -> tuple[float, Scores]:
        """What the best checkpoint has least of, and all that is told."""


class PairTask:
    """IDAM on pairs of ModelNet40's shapes, validated by the errors of the network alone."""

    data = "ModelNet40, 1024 points a shape, training split less the validation shapes"

    def __init__(self, recipe: Recipe, data: str | Path, precision: str) -> None:
        self.recipe = recipe
        self.shapes, self.pairs = split_validation(experiment_shapes(recipe.experiment, data, "train"), recipe)
        self.module = SupervisedStep(initial_model(recipe), recipe, precision)
        self.pool = None
        if recipe.pool is not None:
            self.pool = Pool(self.shapes, recipe, self.module.model)
            self.module.model.features.requires_grad_(False)
        self.size = len(self.shapes if self.pool is None else self.pool)
        self.held = f"{len(self.pairs)} shapes held out of the training split"

    def batch(self, step: int, rank: int, world: int) -> Batch:
        """See :func:`idam.lab.training.batches.batch_at`, and :class:`idam.lab.training.pool.Pool`."""
        if self.pool is not None:
            return self.pool.batch(step, rank, world)
        return batch_at(self.shapes, self.recipe, step, rank, world)

    def validate(self) -> tuple[float, Metrics]:
        """MAE(R), and all errors."""
        scores = validate(self.module.model, self.pairs)
        return scores.mae_r, scores


@torch.inference_mode()
def validate(model: nn.Module, pairs: Pairs, batch_size: int = 50) -> Metrics:
    """Errors of the network alone on pairs; its output has a rotation and a translation."""
    was_training, device = model.training, next(model.parameters()).device
    model.eval()
    estimates = []
    for start in range(0, len(pairs), batch_size):
        batch = pairs[start : start + batch_size].to(device)
        output = model(batch.source, batch.target)
        estimates.append((output.rotation.cpu(), output.translation.cpu()))
    model.train(was_training)
    rotation, translation = (torch.cat(parts) for parts in zip(*estimates, strict=True))
    return measure(rotation, translation, pairs.rotation, pairs.translation)
