"""IDAM's network alone, without refinement: the paper's own rows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from idam import rigid
from idam.align import align, reaches
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.errors import InputError
from idam.lab.evaluation.methods import Method
from idam.lab.settings import with_settings
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.weights import list_models

__all__ = [
    "ablation",
    "ablation_weights",
    "as_method",
    "find_ablation_weights",
    "fpfh",
    "gnn",
    "gnn_then_icp",
    "load_network",
    "weights_for",
]


MADE_BY = (
    "make them with python benchmarks/ablation.py FOLDER --data DIR, and name the FOLDER by --model or IDAM_ABLATION"
)
INFERENCE = ("iterations", "keep", "keep_again", "trusted", "keep_matches", "soft_matches")
"""What may be set of a trained network; the rest is built in, and setting it would change nothing."""


def gnn(model: str | None, settings: Sequence[str]) -> Method:
    """The network on GNN features; ``gnn-unseen-shapes`` unless another model is named."""
    return _alone("gnn", model or "gnn-unseen-shapes", settings)


def fpfh(model: str | None, settings: Sequence[str]) -> Method:
    """The network on FPFH features; ``fpfh-unseen-shapes`` unless another model is named."""
    return _alone("fpfh", model or "fpfh-unseen-shapes", settings)


def gnn_then_icp(model: str | None, settings: Sequence[str]) -> Method:
    """The network on GNN features, and a symmetric ICP after it, as :func:`idam.register` ends sparse clouds with."""
    network = gnn(model, settings)

    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        moving, fixed = source.astype(np.float64), target.astype(np.float64)
        surfaces = Surfaces(Surface.of(moving), Surface.of(fixed), max(spacing_of(moving), spacing_of(fixed)))
        transformation = network(source, target)
        for reach in reaches("symmetric"):
            transformation = align(surfaces, transformation, reach, "symmetric")
        return transformation

    return run


def ablation(model: str | None, settings: Sequence[str]) -> Method:
    """A network with parts of the paper taken out, which it must have been trained without.

    Raises:
        InputError: no model is named.
    """
    if model is None:
        raise InputError(f"a row of the ablation has weights of its own: {MADE_BY}")
    return _alone("gnn", model, settings)


def ablation_weights(method: str, folder: Path) -> Path:
    """Where the weights of a row of the ablation are in a folder of them."""
    return folder / f"gnn-{method}.safetensors"


def find_ablation_weights(method: str, model: str | None) -> str:
    """The file of the weights of a row of the ablation.

    Args:
        method: the row.
        model: their folder, or a file of its own; None for the folder that IDAM_ABLATION names.

    Raises:
        InputError: the folder is not named, or does not hold them.
    """
    place = Path(model or os.environ.get("IDAM_ABLATION", ""))
    path = place if place.suffix == ".safetensors" else ablation_weights(method, place)
    if not path.is_file():
        raise InputError(f"{path}: no such weights of the ablation; {MADE_BY}")
    return str(path)


def weights_for(method: str, experiment: str | None) -> str | None:
    """The weights trained for an experiment, where the method is the network alone and there are any.

    For the paper's inference those trained for it come first: ours keeps more points, and tries again.
    """
    if "-idam" not in method:
        return None
    name = f"{method.split('-')[0]}-{experiment}"
    names = (f"{name}-paper", name) if method.endswith("-paper") else (name,)
    return next((name for name in names if name in list_models()), None)


def _alone(features: str, model: str, settings: Sequence[str]) -> Method:
    return as_method(load_network(features, model, settings))


def load_network(features: str, model: str, settings: Sequence[str], device: str | None = None) -> IDAM:
    """The network of a row.

    Args:
        features: that it must have.
        model: name or file of the weights.
        settings: of the inference, each ``NAME=VALUE``.
        device: where to put it; the CPU if None.

    Raises:
        InputError: the weights, a setting or the device cannot be used, or the network has other features.
    """
    network = load_model(model, device)
    if network.config.features != features:
        raise InputError(
            f"{model} has {network.config.features} features, which this method is not about: give --model a network "
            f"of {features} features, or use --method register"
        )
    network.config = with_settings(network.config, settings, INFERENCE)
    return network


def as_method(network: nn.Module) -> Method:
    """A network whose output for (1, N, 3) and (1, M, 3) has a rotation and a translation, as a method."""
    device = next(network.parameters()).device

    @torch.inference_mode()
    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        try:
            output = network(*(torch.from_numpy(cloud)[None].to(device) for cloud in (source, target)))
        except ValueError as error:  # clouds with too few points for the features
            raise InputError(str(error)) from None
        rotation = rigid.nearest_rotation(output.rotation[0].double().cpu().numpy())
        return rigid.transform(rotation, output.translation[0].double().cpu().numpy())

    return run
