"""The shipped models: names, weights, configuration and provenance, all in one safetensors file each."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from idam.errors import InputError
from idam.io.files import write_bytes
from idam.network.config import Config
from idam.network.model import IDAM

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["UNREADABLE", "list_models", "load_model", "provenance", "read_weights", "save_model", "save_weights"]

DEFAULT = "general"
"""The model behind the name ``default``: for scans of any kind, in any pose."""


UNREADABLE = (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, RuntimeError)
"""What reading weights raises where the file is something else or of another network."""


def list_models() -> list[str]:
    """Names of the shipped models, for :func:`load_model`."""
    return sorted(Path(entry.name).stem for entry in _folder().iterdir() if entry.name.endswith(".safetensors"))


def load_model(name: str | os.PathLike[str] = "default", device: str | torch.device | None = None) -> IDAM:
    """A model with its weights, in evaluation mode.

    Args:
        name: one of :func:`list_models`, ``default``, or the path of a ``.safetensors`` file that ``idam train`` wrote.
        device: where to put it; the CPU if None.

    Raises:
        InputError: there is no such model, or the file is not a model.
    """
    path = find(name)
    try:
        config, state = read_weights(path)
        model = IDAM(Config(**config))
        model.load_state_dict(state)
    except UNREADABLE as error:
        reason = str(error).splitlines()[0][:120]
        raise InputError(f"{path}: not a model that idam wrote ({reason}); use one of {_names()}") from None
    try:
        return model.eval().requires_grad_(False).to(device or "cpu")
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0][:120]
        raise InputError(f"device {str(device)!r} cannot be used ({reason}); leave it out for the CPU") from None


def provenance(name: str | os.PathLike[str]) -> dict[str, Any]:
    """How a model came about: experiment, data, seed, command, commit, steps and scores."""
    path = find(name)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
        return {"config": _config(metadata), **json.loads(metadata.get("provenance", "{}"))}
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not a model that idam wrote ({error})") from None


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
    state = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    metadata = {"config": json.dumps(asdict(config)), "provenance": json.dumps(provenance)}
    write_bytes(path, save(state, metadata))


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration and the weights that :func:`save_weights` wrote; raise one of UNREADABLE where it did not."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
        state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    return _config(metadata), state


def find(name: str | os.PathLike[str]) -> Path:
    """The file of a model.

    Raises:
        InputError: there is no such model.
    """
    if os.fspath(name) == "default":
        name = DEFAULT
    path = Path(name)
    if path.suffix != ".safetensors":
        path = Path(str(_folder() / f"{os.fspath(name)}.safetensors"))
    if not path.is_file():
        raise InputError(
            f"unknown model {os.fspath(name)!r}: use one of {_names()}, or the path of a .safetensors file"
        )
    return path


def _config(metadata: dict[str, str]) -> dict[str, Any]:
    """Arguments of :class:`Config`; JSON knows no tuples."""
    return {key: tuple(x) if isinstance(x, list) else x for key, x in json.loads(metadata["config"]).items()}


def _names() -> str:
    return ", ".join(["default", *list_models()])


def _folder() -> Any:
    return resources.files("idam") / "weights"
