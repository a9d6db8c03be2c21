"""IDAM's network alone, without refinement: the paper's own rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from idam.align import align, reaches
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.errors import InputError
from idam.lab.evaluation.methods import ABLATION, RIVALS, Method
from idam.lab.evaluation.methods.learned.weights import rival_weights_for
from idam.lab.settings import with_settings
from idam.network.pretrained import list_models, load_model

__all__ = ["ablation", "as_method", "fpfh", "gnn", "gnn_then_icp", "weights_for"]


def gnn(model: str | None, settings: Sequence[str]) -> Method:
    """The network on GNN features; ``gnn-unseen-shapes`` unless another model is named."""
    return _alone(model or "gnn-unseen-shapes", settings)


def fpfh(model: str | None, settings: Sequence[str]) -> Method:
    """The network on FPFH features; ``fpfh-unseen-shapes`` unless another model is named."""
    return _alone(model or "fpfh-unseen-shapes", settings)


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
        raise InputError("name the model, such as gnn-ablation-bs: a row of the ablation has weights of its own")
    return _alone(model, settings)


def weights_for(method: str, experiment: str | None) -> str | None:
    """The weights trained for an experiment, where the method is a rival, or the network alone and there are any."""
    if method in RIVALS:
        return rival_weights_for(method, experiment)
    if method in ABLATION:
        name = f"gnn-{method}"
    elif "-idam" in method:
        name = f"{method.split('-')[0]}-{experiment}"
    else:
        return None
    return name if name in list_models() else None


def _alone(model: str, settings: Sequence[str]) -> Method:
    network = load_model(model)
    network.config = with_settings(network.config, settings)
    return as_method(network)


def as_method(network: nn.Module) -> Method:
    """A network whose output for (1, N, 3) and (1, M, 3) has a rotation and a translation, as a method."""

    @torch.inference_mode()
    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        try:
            output = network(torch.from_numpy(source)[None], torch.from_numpy(target)[None])
        except ValueError as error:  # clouds with too few points for the features
            raise InputError(str(error)) from None
        transformation = np.eye(4)
        transformation[:3, :3] = output.rotation[0].numpy()
        transformation[:3, 3] = output.translation[0].numpy()
        return transformation

    return run
