"""What every learned rival is: a network that answers with a transform, and its loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from idam.lab.data.pairs import Pairs

if TYPE_CHECKING:
    from idam.lab.training.log import Parts

__all__ = ["Estimate", "Rival", "motion_errors"]


class Estimate(NamedTuple):
    """Rotations (B, 3, 3) and translations (B, 3) that lay the sources on the targets."""

    rotation: Tensor
    translation: Tensor


class Rival(nn.Module, ABC):
    """A network from (B, N, 3) and (B, M, 3) to an :class:`Estimate`, and how it is trained.

    Attributes:
        name: of the method.
        configuration: the class of its sizes and settings, whose defaults are the paper's.
        learning_rate: Adam's, at the start.
        weight_decay: Adam's.
        config: its sizes and settings.
    """

    name: ClassVar[str]
    configuration: ClassVar[type]
    learning_rate: ClassVar[float] = 1e-3
    weight_decay: ClassVar[float] = 0.0
    config: Any

    @abstractmethod
    def forward(self, source: Tensor, target: Tensor) -> Estimate:
        """The transforms of a batch of pairs."""

    @abstractmethod
    def loss(self, pairs: Pairs) -> Parts:
        """The loss of a batch of pairs, a mean over them, by its parts."""


def motion_errors(estimate: Estimate, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """|R^T R* - I|^2 and |t - t*|^2, means over the batch (DCP, section 4.5; PRNet, equation 13)."""
    turn = estimate.rotation.transpose(-1, -2) @ rotation - torch.eye(3, device=rotation.device)
    return turn.square().sum((-2, -1)).mean(), (estimate.translation - translation).square().sum(-1).mean()
