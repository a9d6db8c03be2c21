"""PRNet: keypoints, sampled matches, iterations (Wang and Solomon, NeurIPS 2019)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.lab.data.pairs import Pairs
from idam.network.geometry import apply_transform, compose, gather_points, invert

from .features import FeatureConfig, Features, procrustes, similarity
from .rival import Estimate, Rival, motion_errors

__all__ = ["Config", "Loss", "PRNet", "keypoints", "straight_through"]

DISCOUNT = 0.9
"""Of each further iteration's loss (equation 12)."""

CYCLE = ALIGNMENT = 0.1
"""Weights of the cycle loss and of the alignment of global features (equation 12), as the authors published them."""

TEMPERATURES = (0.01, 100.0)
"""Bounds of the predicted temperature, about which the paper is silent."""


@dataclass(frozen=True)
class Config(FeatureConfig):
    """Sizes and settings; the defaults are the paper's.

    Attributes:
        keypoints: kept of each cloud, at most.
        iterations: how often the clouds are matched.
    """

    keypoints: int = 512
    iterations: int = 3


class Loss(NamedTuple):
    """The motion, cycle and alignment losses, discounted and weighted (equation 12)."""

    motion: Tensor
    cycle: Tensor
    alignment: Tensor

    @property
    def total(self) -> Tensor:
        """The sum that is minimised."""
        return self.motion + self.cycle + self.alignment


class Matching(NamedTuple):
    """One iteration: the transform, the one the other way round, and both clouds' mean features (B, C)."""

    estimate: Estimate
    back: Estimate
    source_mean: Tensor
    target_mean: Tensor


class Temperature(nn.Module):
    """The temperature (B, 1, 1) from how far apart the clouds' mean features are (section 3.2, Theta).

    Where the paper is silent: three hidden layers of 128, on the absolute difference, and softplus to keep it positive.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        widths = [nn.Linear(i, 128) for i in (channels, 128, 128)]
        self.layers = nn.Sequential(*(part for layer in widths for part in (layer, nn.ReLU())), nn.Linear(128, 1))

    def forward(self, source_mean: Tensor, target_mean: Tensor) -> Tensor:
        """Of mean features (B, C) and (B, C)."""
        temperature = F.softplus(self.layers((source_mean - target_mean).abs()))
        return temperature.clamp(*TEMPERATURES).unsqueeze(-1)


class PRNet(Rival):
    """Features in view of each other, keypoints, a sampled match each, SVD; again with the moved source (section 3.2).

    Where the paper is silent: the moves of earlier iterations pass no gradient, each iteration learning from its own
    loss; products are scaled as in attention; matches are sampled with noise in training, and after it not; rate and
    weight decay are DCP's.
    """

    name = "prnet"
    configuration = Config
    weight_decay = 1e-4

    def __init__(self, config: Config | None = None) -> None:
        super().__init__()
        self.config = config or Config()
        self.features = Features(self.config)
        self.temperature = Temperature(self.config.widths[-1])

    def forward(self, source: Tensor, target: Tensor) -> Estimate:
        """The transforms of pairs (B, N, 3) and (B, M, 3)."""
        graphs = self.features.graphs(source, target)
        total: Estimate | None = None
        for _ in range(self.config.iterations):
            step = self.match(source, target, graphs).estimate
            source = apply_transform(source, *step)
            total = step if total is None else Estimate(*compose(*step, *total))
        assert total is not None
        return total

    def match(self, source: Tensor, target: Tensor, graphs: tuple[Tensor, Tensor]) -> Matching:
        """One iteration on pairs (B, N, 3) and (B, M, 3)."""
        source_features, target_features = self.features(source, target, graphs)
        means = source_features.mean(1), target_features.mean(1)
        kept, target_kept = (keypoints(x, self.config.keypoints) for x in (source_features, target_features))
        source, target = gather_points(source, kept), gather_points(target, target_kept)
        source_features = gather_points(source_features, kept)
        target_features = gather_points(target_features, target_kept)
        scores, temperature = similarity(source_features, target_features), self.temperature(*means)
        return Matching(
            procrustes(source, straight_through(scores, temperature, noisy=self.training), target),
            procrustes(target, straight_through(scores.transpose(-1, -2), temperature, noisy=self.training), source),
            *means,
        )

    def loss(self, pairs: Pairs) -> Loss:
        """The loss of B pairs: a discounted sum over the iterations, each against the motion left (equation 5)."""
        source, rotation, translation = pairs.source, pairs.rotation, pairs.translation
        graphs = self.features.graphs(source, pairs.target)
        losses = []
        for n in range(self.config.iterations):
            matching = self.match(source, pairs.target, graphs)
            losses.append([DISCOUNT**n * part for part in iteration_loss(matching, rotation, translation)])
            step = Estimate(*(part.detach() for part in matching.estimate))
            source = apply_transform(source, *step)
            rotation, translation = compose(rotation, translation, *invert(*step))
        return Loss(*(torch.stack(parts).sum() for parts in zip(*losses, strict=True)))


def iteration_loss(matching: Matching, rotation: Tensor, translation: Tensor) -> Loss:
    """The parts of one iteration's loss, weighted (equation 12).

    The cycle is the transform after the one back, which should leave all in place. The distance of the global features
    is a mean over channels.
    """
    cycle = Estimate(*compose(*matching.estimate, *matching.back))
    at_rest = torch.eye(3, device=rotation.device), torch.zeros_like(translation)
    return Loss(
        torch.stack(motion_errors(matching.estimate, rotation, translation)).sum(),
        CYCLE * torch.stack(motion_errors(cycle, *at_rest)).sum(),
        ALIGNMENT * F.mse_loss(matching.source_mean, matching.target_mean),
    )


def keypoints(features: Tensor, count: int) -> Tensor:
    """Rows (B, K) of the features (B, N, C) of largest norm, K the lesser of ``count`` and N (equation 9)."""
    rows: Tensor = features.norm(dim=-1).topk(min(count, features.shape[1])).indices
    return rows


def straight_through(scores: Tensor, temperature: Tensor, *, noisy: bool) -> Tensor:
    """One-hot matches (B, N, M) of scores (B, N, M), with the gradient of a softmax (equation 11).

    Args:
        scores: similarities.
        temperature: (B, 1, 1), of the softmax.
        noisy: add Gumbel noise, which samples the match from the softmax of the scores.
    """
    if noisy:
        scores = scores - torch.empty_like(scores).exponential_().log()
    soft = (scores / temperature).softmax(-1)
    hard = torch.zeros_like(soft).scatter_(-1, scores.argmax(-1, keepdim=True), 1.0)
    matches: Tensor = hard + (soft - soft.detach())
    return matches
