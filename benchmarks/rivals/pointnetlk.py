"""PointNetLK: Lucas and Kanade's alignment of global features (Aoki et al., CVPR 2019)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam.lab.data.pairs import Pairs
from idam.network.geometry import apply_transform, compose, gather_points
from idam.network.layers import NormalisedLinear

from .rival import Estimate, Rival
from .twist import twist_to_transform

__all__ = ["Config", "Loss", "PointNet", "PointNetLK", "pseudo_inverse"]

DAMPING = 1e-6
"""Share of the mean diagonal that keeps J^T J invertible."""


@dataclass(frozen=True)
class Config:
    """Sizes and settings; the defaults are the paper's.

    Attributes:
        widths: channels of PointNet's layers.
        iterations: of Lucas and Kanade, at most.
        step: of the finite differences of the twist.
        stop: largest coordinate of a twist that ends the iterations.
    """

    widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    iterations: int = 10
    step: float = 1e-2
    stop: float = 1e-7


class Loss(NamedTuple):
    """|T^-1 T* - I|, Frobenius (section 3.3), and the features' square difference after alignment.

    The paper gives the residual no weight: here it is a mean over channels, with weight 1.
    """

    motion: Tensor
    residual: Tensor

    @property
    def total(self) -> Tensor:
        """The sum that is minimised."""
        return self.motion + self.residual


class PointNet(nn.Module):
    """One feature of a cloud: an MLP on each point, then the maximum over the points (no T-nets).

    It always normalises by its running statistics, which :meth:`observe` alone updates: finite differences are
    derivatives only where all clouds are normalised alike.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        *shared, last = (NormalisedLinear(i, o) for i, o in pairwise((3, *widths)))
        self.shared, self.last = nn.ModuleList(shared), last
        self.train()

    def train(self, mode: bool = True) -> PointNet:
        """Stay as in evaluation."""
        return super().train(False)

    @torch.no_grad()
    def observe(self, points: Tensor) -> None:
        """Take the statistics of points (B, N, 3) into account."""
        for layer in (*self.shared, self.last):
            layer.train()
            points = layer(points)
            layer.eval()

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, C) of points (B, N, 3)."""
        for layer in self.shared:
            points = layer(points)
        weight, bias = self.last.projection()
        # the last layer is most of the work, and each of its maxima depends on one point: the others need no gradient
        with torch.no_grad():
            most = torch.stack([(weight @ cloud.T).argmax(-1) for cloud in points])
        largest = torch.linalg.vecdot(gather_points(points, most), weight)
        return F.relu(largest if bias is None else largest + bias)


class PointNetLK(Rival):
    """Inverse compositional Lucas and Kanade on PointNet's features (section 3).

    Where the paper is silent: both clouds are centred on their means first; Adam's rate is 1e-3, without weight decay;
    and PointNet starts from random weights, so that what the rivals have seen is the same (the paper's was trained to
    classify before).
    """

    name = "pointnetlk"
    configuration = Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__()
        self.config = config or Config()
        self.features = PointNet(self.config.widths)

    def forward(self, source: Tensor, target: Tensor) -> Estimate:
        """The transforms of pairs (B, N, 3) and (B, M, 3); the target is the template."""
        return self.align(source, target)[0]

    def align(self, source: Tensor, target: Tensor) -> tuple[Estimate, Tensor]:
        """The transforms, and phi(P_S) - phi(P_T) (B, C) before the last step."""
        source_mean, target_mean = source.mean(1, keepdim=True), target.mean(1, keepdim=True)
        template = target - target_mean
        feature: Tensor = self.features(template)
        inverse = pseudo_inverse(self.jacobian(template, feature))
        rotation = torch.eye(3, dtype=source.dtype, device=source.device).expand(len(source), 3, 3)
        translation = -source_mean.squeeze(1)
        for _ in range(self.config.iterations):
            residual = self.features(apply_transform(source, rotation, translation)) - feature
            twist = torch.einsum("bkc,bc->bk", inverse, residual)
            rotation, translation = compose(*twist_to_transform(twist), rotation, translation)
            if twist.detach().abs().max() < self.config.stop:
                break
        return Estimate(rotation, translation + target_mean.squeeze(1)), residual

    def jacobian(self, template: Tensor, feature: Tensor) -> Tensor:
        """Finite differences for d phi(exp(-twist) P_T) / d twist, (B, C, 6)."""
        twists = -self.config.step * torch.eye(6, dtype=template.dtype, device=template.device)
        moved = apply_transform(template.unsqueeze(1), *twist_to_transform(twists))
        features = self.features(moved.flatten(0, 1)).unflatten(0, (len(template), 6))
        jacobian: Tensor = (features - feature.unsqueeze(1)).mT / self.config.step
        return jacobian

    def loss(self, pairs: Pairs) -> Loss:
        """The loss of B pairs."""
        if self.training:
            self.features.observe(torch.cat([x - x.mean(1, keepdim=True) for x in (pairs.source, pairs.target)]))
        (rotation, translation), residual = self.align(pairs.source, pairs.target)
        turn = rotation.mT
        left = turn @ pairs.rotation - torch.eye(3, device=turn.device)
        moved = turn @ (pairs.translation - translation).unsqueeze(-1)
        motion = torch.cat([left, moved], -1).flatten(1).norm(dim=-1)
        return Loss(motion.mean(), residual.square().mean())


def pseudo_inverse(jacobian: Tensor) -> Tensor:
    """(J^T J)^-1 J^T, (B, C, 6) -> (B, 6, C)."""
    normal = jacobian.mT @ jacobian
    size = normal.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(normal.dtype).eps)[:, None, None]
    damped = normal + DAMPING * size * torch.eye(6, dtype=normal.dtype, device=normal.device)
    inverse: Tensor = torch.linalg.solve(damped, jacobian.mT)
    return inverse
