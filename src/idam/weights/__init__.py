"""The shipped models: names, weights, configuration and provenance, all in one safetensors file each."""

from __future__ import annotations

import json
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from idam.describe.invariant import Descriptor
from idam.errors import InputError

__all__ = [
    "DEFAULT",
    "SMALLEST",
    "SPARSE",
    "UNREADABLE",
    "find",
    "is_descriptor",
    "list_models",
    "load_descriptor",
    "not_a_model",
    "provenance",
    "read_weights",
    "without_denormals",
]

DEFAULT = "general"
"""The model behind the name ``default``: for scans of any kind, in any pose."""
SPARSE = "practice-any-rotation"
"""What the default model also asks where sparse clouds stay in doubt: it learnt from independent samplings alone.
Of 120 pairs of halves of ModelNet40's test shapes 98 come out right with it and 92 without, 47 and 33 of them sure."""
FOLDER = Path(__file__).parent
UNREADABLE = (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, RuntimeError)
"""What reading weights raises where the file is something else or of another network."""
SMALLEST = 1e-12
"""Weights below it in magnitude are zero: weight decay left them, and no sum of float32 feels them.

The processor takes some 150 cycles for a product with a denormal number (below 1.2e-38), and products of weights with
one another and with small features get there from far above. With 18 % of its weights below 1e-20, ``general`` took
72 ms to describe 1024 points where it takes 12 without them (torch, one core of an Intel Xeon).
"""


def list_models() -> list[str]:
    """Names of the shipped models."""
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def find(name: str | os.PathLike[str]) -> Path:
    """The file of a model.

    Args:
        name: one of :func:`list_models`, ``default``, or the path of a ``.safetensors`` file.

    Raises:
        InputError: there is no such model.
    """
    if os.fspath(name) == "default":
        name = DEFAULT
    path = Path(name)
    if path.suffix != ".safetensors":
        path = FOLDER / f"{os.fspath(name)}.safetensors"
    if not path.is_file():
        raise InputError(
            f"unknown model {os.fspath(name)!r}: use one of {_names()}, or the path of a .safetensors file"
        )
    return path


def provenance(name: str | os.PathLike[str]) -> dict[str, Any]:
    """How a model came about: experiment, data, seed, command, commit, steps and scores.

    Raises:
        InputError: there is no such model, or the file is not a model.
    """
    path = find(name)
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
        return {"config": _config(metadata), **json.loads(metadata.get("provenance", "{}"))}
    except UNREADABLE as error:
        raise not_a_model(path, error) from None


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The configuration and the weights of a model's file; raise one of UNREADABLE where it is something else."""
    with safe_open(path, "np") as file:
        metadata = file.metadata() or {}
        weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    return _config(metadata), weights


def is_descriptor(name: str | os.PathLike[str]) -> bool:
    """Whether a model's features do not change with the pose; raise InputError where it is not a model."""
    return bool(provenance(name)["config"].get("features") == "invariant")


def load_descriptor(name: str | os.PathLike[str] = "default") -> Descriptor:
    """The descriptor of a model whose features do not change with the pose; read again where the file has changed.

    Raises:
        InputError: there is no such model, the file is not a model, or its features change with the pose.
    """
    path = find(name).resolve()
    status = path.stat()
    return _descriptor(path, status.st_mtime_ns, status.st_size)


@lru_cache(4)
def _descriptor(path: Path, modified: int, size: int) -> Descriptor:
    try:
        config, weights = read_weights(path)
        if config.get("features") == "invariant":
            prefix = "features."
            return Descriptor({key.removeprefix(prefix): x for key, x in weights.items() if key.startswith(prefix)})
    except UNREADABLE as error:
        raise not_a_model(path, error) from None
    raise InputError(f"{path}: its features change with the pose; name a model such as {DEFAULT}")


def not_a_model(path: Path, error: BaseException) -> InputError:
    """The error that tells why a file is not a model, and which there are."""
    reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
    return InputError(f"{path}: not a model that idam wrote ({reason}); use one of {_names()}")


def without_denormals(weights: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Weights with those of no effect, below 1e-12 in magnitude, set to zero."""
    return {key: np.where(np.abs(x) < SMALLEST, x.dtype.type(0), x) for key, x in weights.items()}


def _config(metadata: dict[str, str]) -> dict[str, Any]:
    """Arguments of :class:`idam.network.config.Config`; JSON knows no tuples."""
    return {key: tuple(x) if isinstance(x, list) else x for key, x in json.loads(metadata["config"]).items()}


def _names() -> str:
    return ", ".join(["default", *list_models()])
