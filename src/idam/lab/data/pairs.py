"""The paper's partial-overlap protocol (section 4): pairs of partially overlapping clouds from whole shapes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from idam.network.geometry import apply_transform, euler_xyz_to_rotation, gather_points

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    D = TypeVar("D", bound=DataclassInstance)

__all__ = ["EXPERIMENTS", "Pairs", "drawn_singly", "experiment_noise", "fixed_pairs", "make_pairs"]

EXPERIMENTS = ("unseen-shapes", "unseen-categories", "gaussian-noise")
"""The paper's experiments (sections 4.1 to 4.3)."""

NOISE = 0.01
MAX_ANGLE = math.radians(45)
MAX_TRANSLATION = 0.5
CROPPED_POINTS = 768
FAR = 500.0
NOISE_CLIP = 0.05


@dataclass(frozen=True)
class Pairs:
    """B pairs: source (B, N, 3), target (B, P, 3), and the truth, target = R source + t: (B, 3, 3) and (B, 3)."""

    source: Tensor
    target: Tensor
    rotation: Tensor
    translation: Tensor

    def __len__(self) -> int:
        return len(self.source)

    def to(self, device: torch.device | str) -> Pairs:
        """The same pairs on another device."""
        return Pairs(*(getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)))

    def __getitem__(self, index: slice | Tensor) -> Pairs:
        return Pairs(*(getattr(self, f.name)[index] for f in fields(self)))


@dataclass(frozen=True)
class _Draw:
    """All that is random about B pairs."""

    angles: Tensor
    translation: Tensor
    order: Tensor
    noise: Tensor
    far: Tensor


def experiment_noise(experiment: str) -> float:
    """Sigma of an experiment's noise on every coordinate of both clouds."""
    return NOISE if experiment == "gaussian-noise" else 0.0


def make_pairs(points: Tensor, generator: torch.Generator, noise: float = 0.0) -> Pairs:
    """Pairs from whole shapes (B, N, 3), drawn from ``generator`` as one batch.

    R = Rx Ry Rz with angles from U[0, 45] degrees, t from U[-0.5, 0.5]^3; the target is the transformed shape in its
    own random order; noise N(0, sigma), clipped to +-0.05, on every coordinate of both; one far point per pair, +-500
    on each axis plus U[0, 1], keeps the 768 points nearest to it of each cloud.

    Args:
        points: whole shapes (B, N, 3).
        generator: on the CPU.
        noise: sigma; 0 for none.
    """
    return _build(points, _draw(len(points), points.shape[1], generator, noise))


def fixed_pairs(points: Tensor, seed: int, noise: float = 0.0) -> Pairs:
    """Test pairs from whole shapes (B, N, 3): each depends on the seed and its index alone."""
    return _build(
        points, drawn_singly(lambda generator: _draw(1, points.shape[1], generator, noise), len(points), seed)
    )


def drawn_singly(draw: Callable[[torch.Generator], D], count: int, seed: int) -> D:
    """``count`` draws (dataclasses of tensors (1, ...)) as one, each from the seed and its index alone."""
    draws = [draw(torch.Generator().manual_seed(seed * 1_000_003 + index)) for index in range(count)]
    return type(draws[0])(*(torch.cat([getattr(d, f.name) for d in draws]) for f in fields(draws[0])))


def _draw(count: int, points: int, generator: torch.Generator, noise: float) -> _Draw:
    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    shape = (count, 2, points, 3) if noise else (count, 2, 1, 1)
    return _Draw(
        angles=uniform(count, 3) * MAX_ANGLE,
        translation=(uniform(count, 3) * 2 - 1) * MAX_TRANSLATION,
        order=uniform(count, points).argsort(-1),
        noise=(torch.randn(shape, generator=generator) * noise).clamp_(-NOISE_CLIP, NOISE_CLIP),
        far=torch.randint(0, 2, (count, 3), generator=generator) * 2 * FAR - FAR + uniform(count, 3),
    )


def _build(points: Tensor, draw: _Draw) -> Pairs:
    rotation = euler_xyz_to_rotation(draw.angles)
    target = gather_points(apply_transform(points, rotation, draw.translation), draw.order)
    source_noise, target_noise = draw.noise.unbind(1)
    return Pairs(
        _nearest_to(points + source_noise, draw.far),
        _nearest_to(target + target_noise, draw.far),
        rotation,
        draw.translation,
    )


def _nearest_to(points: Tensor, far: Tensor) -> Tensor:
    """The points (B, 768, 3) of (B, N, 3) nearest to one far point each (B, 3)."""
    # |p - f|^2 = |p|^2 - 2 p.f + const: without the constant, which would swallow single precision
    distance = points.square().sum(-1) - 2 * (points @ far.unsqueeze(-1)).squeeze(-1)
    return gather_points(
        points, distance.topk(min(CROPPED_POINTS, points.shape[1]), largest=False).indices.sort(-1).values
    )
