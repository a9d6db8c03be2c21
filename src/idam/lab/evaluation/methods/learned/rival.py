"""What every learned rival is: a network that answers with a transform, and its loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from idam.errors import InputError
from idam.lab.data.pairs import Pairs
from idam.lab.evaluation.methods import Method
from idam.lab.evaluation.methods.learned.weights import find_rival_weights
from idam.lab.evaluation.methods.network import as_method
from idam.lab.settings import with_settings
from idam.network.pretrained import restore
from idam.weights import UNREADABLE, read_weights

if TYPE_CHECKING:
    from idam.lab.training.log import Parts

__all__ = ["Estimate", "Rival", "build_rival", "load_rival", "motion_errors"]


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


R = TypeVar("R", bound=Rival)


def load_rival(rival: type[R], model: str | None) -> R:
    """A rival with its weights, in evaluation mode (:func:`.weights.find_rival_weights`).

    Raises:
        InputError: the file is missing, or not one of this rival's.
        MissingDependencyError: the weights are still to be trained.
    """
    path = find_rival_weights(rival.name, model)
    try:
        config, weights = read_weights(path)
        network = rival(rival.configuration(**config))
        restore(network, weights)
    except UNREADABLE as error:
        raise InputError(f"{path}: not a model of {rival.name} ({str(error).splitlines()[0][:120]})") from None
    return network.eval().requires_grad_(False)


def build_rival(rival: type[Rival], model: str | None, settings: Sequence[str]) -> Method:
    """A rival with its weights, as a method."""
    network = load_rival(rival, model)
    network.config = with_settings(network.config, settings)
    return as_method(network)


def motion_errors(estimate: Estimate, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """|R^T R* - I|^2 and |t - t*|^2, means over the batch (DCP, section 4.5; PRNet, equation 13)."""
    turn = estimate.rotation.transpose(-1, -2) @ rotation - torch.eye(3, device=rotation.device)
    return turn.square().sum((-2, -1)).mean(), (estimate.translation - translation).square().sum(-1).mean()
