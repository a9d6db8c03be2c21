"""IDAM's network alone, without refinement: the paper's own rows."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from idam.errors import InputError
from idam.evaluation.methods import Method
from idam.network.pretrained import load_model

__all__ = ["fpfh", "gnn"]


def gnn(model: str | None) -> Method:
    """The network on GNN features; ``gnn-unseen-shapes`` unless another model is named."""
    return _alone(model or "gnn-unseen-shapes")


def fpfh(model: str | None) -> Method:
    """The network on FPFH features; ``fpfh-unseen-shapes`` unless another model is named."""
    return _alone(model or "fpfh-unseen-shapes")


def _alone(model: str) -> Method:
    network = load_model(model)

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
