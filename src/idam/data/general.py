"""Pairs as practice has them: any rotation, other points, partial views, clutter, noise; drawn without end.

Where the paper's protocol crops two copies of the same points, here each scan samples the surface anew: some by another
density, some seen from a viewpoint that hides what lies behind, some of several objects on a ground. Both clouds are
centred as :func:`idam.register` centres them, so that the network sees in training what it sees in use.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from idam.data.pairs import Pairs
from idam.geometry import gather_points, nearest_neighbours, quaternion_to_rotation, random_rotation, rotations_within

__all__ = ["in_any_pose", "make_general_pairs"]

POINTS = 640
"""Points of each cloud."""
CANDIDATES = 1536
"""Points of each cloud before parts of it are hidden."""
NEIGHBOURS = 6
"""Nearest neighbours that span the triangles a scan's points are drawn from."""
MAX_NOISE = 0.02
MAX_OUTLIERS = 0.04
LEAST_KEPT = 0.55
"""Least share of a cloud that its half-space keeps: two of these overlap by a tenth or more."""
SCENES = 0.35
"""Share of pairs that are several objects on a ground."""
VIEWS = 0.5
"""Share of clouds that are seen from a viewpoint; the others are seen from all sides."""
CORE = 0.98
"""Share of a cloud's points that decide its size."""
GRID = 40
"""Cells along each axis of the image that decides what a viewpoint hides."""

BEHIND = 0.15
"""How far a point must lie behind another to be hidden by it."""


def make_general_pairs(points: Tensor, generator: torch.Generator, max_angle: float = math.pi) -> Pairs:
    """Pairs from whole shapes (B, N, 3), drawn from ``generator`` as one batch.

    Args:
        points: shapes, about as large as the unit sphere.
        generator: on the CPU.
        max_angle: largest angle of the rotation, radians; pi for all of SO(3).
    """
    count = len(points)
    surface = _scenes(in_any_pose(points, generator), generator)
    neighbours = nearest_neighbours(surface, NEIGHBOURS)
    source, target = (_scan(_sampled_anew(surface, neighbours, generator), generator) for _ in range(2))
    rotation = rotations_within(count, max_angle, generator)
    # each cloud about its own mean, and both of unit size, as in use
    centres = [cloud.mean(1, keepdim=True) for cloud in (source, target)]
    source, target = source - centres[0], target - centres[1]
    radius = torch.maximum(*(cloud.norm(dim=-1).quantile(CORE, dim=-1) for cloud in (source, target)))[:, None, None]
    between = (centres[0] - centres[1]) / radius
    turn = rotation.transpose(-1, -2)
    return Pairs(source / radius, target / radius @ turn, rotation, (between @ turn).squeeze(1))


def _uniform(shape: tuple[int, ...], low: float, high: float, generator: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=generator) * (high - low) + low


def in_any_pose(points: Tensor, generator: torch.Generator) -> Tensor:
    """The shapes (B, N, 3), each turned in some way: in practice there is no common upright."""
    return points @ random_rotation(len(points), generator=generator).transpose(-1, -2)


def _scenes(points: Tensor, generator: torch.Generator) -> Tensor:
    """Some of the shapes (B, N, 3) with another beside them and a ground below, as large, of as many points."""
    count, number = points.shape[:2]
    thirds = number // 3
    aside = torch.nn.functional.normalize(torch.randn(count, 1, 3, generator=generator), dim=-1)
    other = points.roll(1, 0) * _uniform((count, 1, 1), 0.5, 1.0, generator)
    other = other + aside * _uniform((count, 1, 1), 0.9, 1.6, generator)
    ground = _uniform((count, number - 2 * thirds, 3), -1.6, 1.6, generator)
    ground[..., 2] = -_uniform((count, 1), 0.3, 1.0, generator)
    scene = torch.cat([points[:, :thirds], other[:, :thirds], ground], 1)
    scene = scene - scene.mean(1, keepdim=True)
    scene = scene / scene.norm(dim=-1).amax(-1)[:, None, None]
    chosen = torch.rand(count, 1, 1, generator=generator) < SCENES
    return torch.where(chosen, scene, points)


def _sampled_anew(surface: Tensor, neighbours: Tensor, generator: torch.Generator) -> Tensor:
    """Other points (B, 1536, 3) of the surfaces: in the triangles of a point (B, N, 3) and two neighbours (B, N, k)."""
    count, number = surface.shape[:2]
    corner = torch.randint(number, (count, CANDIDATES), generator=generator)
    others = torch.randint(NEIGHBOURS, (2, count, CANDIDATES, 1), generator=generator)
    near = gather_points(neighbours, corner)
    corners = [gather_points(surface, rows) for rows in (corner, *(near.gather(2, o).squeeze(2) for o in others))]
    share = torch.empty(3, count, CANDIDATES, 1).exponential_(generator=generator)
    return sum((s * c for s, c in zip(share / share.sum(0), corners, strict=True)), torch.zeros(()))


def _scan(surface: Tensor, generator: torch.Generator) -> Tensor:
    """One scan (B, 640, 3) of surfaces (B, N, 3): part of the points, unevenly dense, with noise and outliers."""
    count = len(surface)
    chance = _inside_half_space(surface, generator) * _seen(surface, generator) * _density(surface, generator)
    # Gumbel's trick: the largest of log chance + noise are a sample without replacement
    noise = -torch.empty(chance.shape).exponential_(generator=generator).log()
    index = (chance.clamp_min(1e-30).log() + noise).topk(POINTS).indices
    # where fewer are left than wanted, some come twice, apart by their noise
    left = (chance > 0).sum(-1, keepdim=True)
    index = index.gather(1, torch.arange(POINTS).expand(count, -1) % left.clamp(1, POINTS))
    scan = gather_points(surface, index)
    sigma = _uniform((count, 1, 1), 0.0, MAX_NOISE, generator)
    scan = scan + torch.randn(scan.shape, generator=generator) * sigma
    stray = _uniform(scan.shape, -1.0, 1.0, generator)
    outlier = torch.rand(count, POINTS, generator=generator) < _uniform((count, 1), 0.0, MAX_OUTLIERS, generator)
    return torch.where(outlier.unsqueeze(-1), stray, scan)


def _inside_half_space(surface: Tensor, generator: torch.Generator) -> Tensor:
    """1 for the points (B, N) lowest along a random direction, a random share of them, 0 for the others."""
    along = (surface @ torch.randn(len(surface), 3, 1, generator=generator)).squeeze(-1)
    share = _uniform((len(surface), 1), LEAST_KEPT, 1.0, generator)
    rank = along.argsort(-1).argsort(-1)
    return (rank < share * surface.shape[1]).float()


def _seen(surface: Tensor, generator: torch.Generator) -> Tensor:
    """1 for the points (B, N) that a viewpoint far away sees, 0 for those behind others; some are seen all around."""
    count = len(surface)
    turned = surface @ quaternion_to_rotation(torch.randn(count, 4, generator=generator)).transpose(-1, -2)
    cell = ((turned[..., :2] + 1) * (GRID / 2)).long().clamp_(0, GRID - 1)
    cell = cell[..., 0] * GRID + cell[..., 1]
    # the surface is thin in the image: each cell also hides what lies behind its neighbours
    depth = torch.full((count, GRID * GRID), torch.inf).scatter_reduce(1, cell, turned[..., 2], "amin")
    depth = -torch.nn.functional.max_pool2d(-depth.view(count, 1, GRID, GRID), 3, 1, 1).flatten(1)
    seen = turned[..., 2] < depth.gather(1, cell) + BEHIND
    around = torch.rand(count, 1, generator=generator) >= VIEWS
    return (seen | around).float()


def _density(surface: Tensor, generator: torch.Generator) -> Tensor:
    """Relative densities (B, N): as 1 / distance^2 from a sensor, near or far."""
    direction = torch.nn.functional.normalize(torch.randn(len(surface), 1, 3, generator=generator), dim=-1)
    sensor = direction * _uniform((len(surface), 1, 1), 1.5, 6.0, generator)
    return 1 / (surface - sensor).square().sum(-1)
