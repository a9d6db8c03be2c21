"""The rivals as methods of ``idam evaluate``, each with the weights that :mod:`benchmarks.rivals.train` wrote.

idam evaluate unseen-shapes --data DIR --method benchmarks.rivals.methods:dcp --model runs/dcp/best.safetensors
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.lab.evaluation.methods import Method
from idam.lab.evaluation.methods.network import as_method
from idam.network.pretrained import restore
from idam.weights import UNREADABLE, read_weights

from .dcp import DCP
from .pointnetlk import PointNetLK
from .prnet import PRNet
from .rival import Rival

__all__ = ["RIVALS", "dcp", "load_rival", "pointnetlk", "prnet"]

Points = NDArray[np.float32]

RIVALS: dict[str, type[Rival]] = {rival.name: rival for rival in (PointNetLK, DCP, PRNet)}


def pointnetlk(source: Points, target: Points, model: str = "") -> NDArray[np.float64]:
    """PointNetLK's transform (4, 4) from source (N, 3) to target (M, 3)."""
    return _method("pointnetlk", model)(source, target)


def dcp(source: Points, target: Points, model: str = "") -> NDArray[np.float64]:
    """DCP-v2's transform (4, 4) from source (N, 3) to target (M, 3)."""
    return _method("dcp", model)(source, target)


def prnet(source: Points, target: Points, model: str = "") -> NDArray[np.float64]:
    """PRNet's transform (4, 4) from source (N, 3) to target (M, 3)."""
    return _method("prnet", model)(source, target)


@cache
def _method(name: str, model: str) -> Method:
    return as_method(load_rival(name, model))


def load_rival(name: str, model: str) -> Rival:
    """A rival with its weights, in evaluation mode.

    Raises:
        InputError: no weights are named, or the file is missing or holds others.
    """
    path = Path(model)
    if not model or not path.is_file():
        raise InputError(
            f"{name} needs --model, the weights that python -m benchmarks.rivals.train {name} writes"
            + (f": there is no file {model}" if model else "")
        )
    try:
        config, state = read_weights(path)
        network = RIVALS[name](RIVALS[name].configuration(**config))
        restore(network, state)
    except UNREADABLE as error:
        raise InputError(f"{path}: not a model of {name} ({str(error).splitlines()[0][:120]})") from None
    return network.eval().requires_grad_(False)
