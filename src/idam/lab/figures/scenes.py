"""What the pictures of clouds show, computed by the network: registrations, key points, correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
from idam.errors import InputError
from idam.io import read_point_cloud
from idam.lab.data.pairs import Pairs
from idam.network.geometry import apply_transform, gather_points, invert
from idam.network.model import IDAM

__all__ = ["Kept", "Matches", "Overlay", "Scan", "first_matches", "kept_points", "lay", "read_scans"]

SCAN_POINTS = 1024
"""Points that the network is given of a scan, as of a shape in training."""

Scan = tuple[str, Tensor, Tensor]
"""Name, source (N, 3) and target (P, 3)."""


@dataclass(frozen=True)
class Overlay:
    """One registration.

    Attributes:
        name: of the shape, or of the scans.
        source: as it was, (N, 3).
        moved: the source as it was moved, (N, 3).
        target: (P, 3).
        upright: the rotation (3, 3) that stands the target upright, to look at it.
    """

    name: str
    source: Tensor
    moved: Tensor
    target: Tensor
    upright: Tensor


@dataclass(frozen=True)
class Kept:
    """A cloud (N, 3), and of it the key points (M, 3) that hard elimination kept."""

    name: str
    cloud: Tensor
    key_points: Tensor


@dataclass(frozen=True)
class Matches:
    """The matches of one iteration.

    Attributes:
        name: of the shape.
        source: the cloud, (N, 3).
        target: the cloud turned back by the true transform, (P, 3): a right match ends where it starts.
        start: the source's key points, (M, 3).
        end: their best target points, turned back as well, (M, 3).
        weighted: which matches hybrid elimination left a weight, (M,).
    """

    name: str
    source: Tensor
    target: Tensor
    start: Tensor
    end: Tensor
    weighted: Tensor


def read_scans(paths: Sequence[Path]) -> list[Scan]:
    """Read pairs of scans and bring them to the network's size.

    Each cloud is centred, both are divided by one scale, so that the larger fits the unit sphere, and thinned out at
    random to 1024 points, always the same ones.

    Args:
        paths: source, target, source, target and so on.

    Raises:
        InputError: a source lacks its target, or a file cannot be read or registered.
    """
    if len(paths) % 2:
        raise InputError(f"{len(paths)} scans: they go in pairs, a source and its target; leave one out or add one")
    return [_read_pair(source, target) for source, target in zip(paths[::2], paths[1::2], strict=True)]


def _read_pair(source_path: Path, target_path: Path) -> Scan:
    source, target = read_point_cloud(source_path).points, read_point_cloud(target_path).points
    clouds = Pyramid(Prepared.of(source, str(source_path)), Prepared.of(target, str(target_path)))
    generator = torch.Generator().manual_seed(0)
    return (
        f"{source_path.stem}\nto {target_path.stem}",
        _thin_out((source - clouds.source.centre) / clouds.unit, generator),
        _thin_out((target - clouds.target.centre) / clouds.unit, generator),
    )


def _thin_out(points: NDArray[np.float64], generator: torch.Generator) -> Tensor:
    return torch.from_numpy(points).float()[torch.randperm(len(points), generator=generator)[:SCAN_POINTS]]


@torch.inference_mode()
def lay(network: IDAM, scan: Scan, upright: Tensor | None = None) -> Overlay:
    """Register a source with a target, which stands upright unless a rotation (3, 3) must bring it there."""
    name, source, target = scan
    output = network(source[None], target[None])
    moved = apply_transform(source, output.rotation[0], output.translation[0])
    return Overlay(name, source, moved, target, torch.eye(3) if upright is None else upright)


@torch.inference_mode()
def kept_points(network: IDAM, name: str, pair: Pairs) -> Kept:
    """The key points of the source of one pair."""
    return Kept(name, pair.source[0], network(pair.source, pair.target).source.points[0])


@torch.inference_mode()
def first_matches(network: IDAM, name: str, pair: Pairs) -> Matches:
    """The matches of the first iteration of one pair."""
    output = network(pair.source, pair.target)
    step = output.iterations[0]
    back = invert(pair.rotation, pair.translation)
    end = gather_points(output.target.points, step.correspondence)
    return Matches(
        name,
        pair.source[0],
        apply_transform(pair.target, *back)[0],
        output.source.points[0],
        apply_transform(end, *back)[0],
        step.weight[0] > 0,
    )
