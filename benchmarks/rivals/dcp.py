"""Deep Closest Point with attention, DCP-v2 (Wang and Solomon, ICCV 2019)."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from idam.lab.data.pairs import Pairs

from .features import FeatureConfig, Features, procrustes, similarity
from .rival import Estimate, Rival, motion_errors

__all__ = ["DCP", "Loss"]


class Loss(NamedTuple):
    """|R^T R* - I|^2 and |t - t*|^2 (section 4.5; its third term is Adam's weight decay)."""

    rotation: Tensor
    translation: Tensor

    @property
    def total(self) -> Tensor:
        """The sum that is minimised."""
        return self.rotation + self.translation


class DCP(Rival):
    """Features in view of each other, a soft pointer, SVD (section 4); rate and weight decay are the paper's."""

    name = "dcp"
    configuration = FeatureConfig
    weight_decay = 1e-4

    def __init__(self, config: FeatureConfig | None = None) -> None:
        super().__init__()
        self.config = config or FeatureConfig()
        self.features = Features(self.config)

    def forward(self, source: Tensor, target: Tensor) -> Estimate:
        """The transforms of pairs (B, N, 3) and (B, M, 3): each point goes to a mean of target points (section 4.3)."""
        features = self.features(source, target, self.features.graphs(source, target))
        return procrustes(source, similarity(*features).softmax(-1), target)

    def loss(self, pairs: Pairs) -> Loss:
        """The loss of B pairs."""
        return Loss(*motion_errors(self(pairs.source, pairs.target), pairs.rotation, pairs.translation))
