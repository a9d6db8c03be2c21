"""One training step: the network and its loss (sections 3.4 and 3.5)."""

from __future__ import annotations

import torch
from torch import nn

from idam.lab.training.batches import Batch
from idam.lab.training.recipe import Recipe
from idam.network.elimination import keep_most_significant
from idam.network.geometry import gather_points
from idam.network.model import IDAM
from idam.network.supervision import Loss, mutual_supervision

__all__ = ["SupervisedStep"]


class SupervisedStep(nn.Module):
    """The network and its loss as one module, so that distributed wrappers see one forward pass."""

    def __init__(self, model: IDAM, recipe: Recipe, precision: str) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe
        self.precision = precision

    def forward(self, batch: Batch) -> Loss:
        """The loss of the pairs on their sampled points."""
        # Fabric's own autocast would round the coordinates on the way in, and the labels need them exact as well
        with torch.autocast(batch.source.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            source_features, target_features = batch.features or self.model.encode(batch.source, batch.target)
            source_significance = self.model.significance(source_features)
            target_significance = self.model.significance(target_features)
            source_index, target_index = batch.source_index, batch.target_index
            if self.recipe.eliminate:
                source_kept, target_index = (
                    keep_most_significant(significance.detach(), self.model.config.keep)
                    for significance in (source_significance, target_significance)
                )
                # drawn samples come positives first: every second one keeps the balance
                source_index = torch.cat([source_index[:, ::2], source_kept[:, : source_index.shape[1] // 2]], 1)
            source, target = gather_points(batch.source, source_index), gather_points(batch.target, target_index)
            iterations = self.model.iterate(
                source,
                target,
                gather_points(source_features, source_index),
                gather_points(target_features, target_index),
                self.recipe.iterations,
            )
        return mutual_supervision(
            iterations,
            source,
            target,
            batch.rotation,
            batch.translation,
            source_significance.gather(1, source_index),
            target_significance.gather(1, target_index),
            self.recipe.radius,
        )
