"""Models in torch, from weights and back: the files are those of :mod:`idam.weights`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import nn

from idam.errors import InputError
from idam.io.files import write_bytes
from idam.network.config import Config
from idam.network.model import IDAM
from idam.weights import UNREADABLE, find, not_a_model, read_weights, without_denormals

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["cached_model", "load_model", "restore", "save_model", "save_weights"]


def load_model(
    name: str | os.PathLike[str] = "default", device: str | torch.device | None = None, *, trainable: bool = False
) -> IDAM:
    """A model with its weights, in single precision and evaluation mode.

    Its parameters are frozen unless it is to be trained; gradients reach its inputs either way.
    Neither torch's random state nor its default dtype matters, and neither changes.

    Args:
        name: one of :func:`idam.list_models`, ``default``, or the path of a ``.safetensors`` file that ``idam train``
            wrote.
        device: where to put it; the CPU if None.
        trainable: whether its parameters take gradients; call ``train()`` for training mode.

    Raises:
        InputError: there is no such model, or the file is not a model.
    """
    path = find(name)
    try:
        config, weights = read_weights(path)
        with torch.device("meta"):  # draws no random weights
            model = IDAM(Config(**config))
        restore(model, weights)
    except UNREADABLE as error:
        raise not_a_model(path, error) from None
    try:
        return model.eval().requires_grad_(trainable).to(device or "cpu")
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0][:120]
        raise InputError(f"device {str(device)!r} cannot be used ({reason}); leave it out for the CPU") from None


def cached_model(name: str | os.PathLike[str], device: str | None = None) -> IDAM:
    """:func:`load_model`, read again only where the file has changed."""
    path = find(name).resolve()
    status = path.stat()
    return _cached(path, status.st_mtime_ns, status.st_size, device)


@lru_cache(4)
def _cached(path: Path, modified: int, size: int, device: str | None) -> IDAM:
    return load_model(path, device)


def restore(network: nn.Module, weights: Mapping[str, NDArray[Any]]) -> None:
    """Give a network the weights that were read; raise RuntimeError where they are another network's."""
    network.load_state_dict({key: torch.tensor(value) for key, value in weights.items()}, assign=True)


def save_model(path: Path, model: IDAM, provenance: dict[str, Any]) -> None:
    """Write weights, configuration and provenance to one file, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    save_weights(path, model, model.config, provenance)


def save_weights(path: Path, network: nn.Module, config: DataclassInstance, provenance: dict[str, Any]) -> None:
    """Write any network's weights, configuration and provenance to one file, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    weights = without_denormals({key: value.detach().cpu().numpy() for key, value in network.state_dict().items()})
    metadata = {"config": json.dumps(asdict(config)), "provenance": json.dumps(provenance)}
    write_bytes(path, save(weights, metadata))
