"""Point features behind one interface: a module (B, N, 3) -> (B, N, channels), with ``channels`` as an attribute."""

from __future__ import annotations

from typing import TYPE_CHECKING

from idam.errors import InputError
from idam.network.features.fpfh import FPFH
from idam.network.features.gnn import GNN
from idam.network.features.invariant import Invariant

if TYPE_CHECKING:
    from idam.network.config import Config

__all__ = ["FPFH", "GNN", "Invariant", "build_features"]


def build_features(config: Config) -> GNN | FPFH | Invariant:
    """The feature extractor that a configuration names.

    Raises:
        InputError: the name is unknown.
    """
    if config.features == "gnn":
        return GNN(config.neighbours)
    if config.features == "fpfh":
        return FPFH(normal_radius=config.normal_radius, feature_radius=config.feature_radius)
    if config.features == "invariant":
        return Invariant()
    raise InputError(f"unknown features {config.features!r}: choose gnn, fpfh or invariant")
