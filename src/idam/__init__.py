"""Learned global registration of partially overlapping 3D point clouds (IDAM, ECCV 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from idam.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    from idam.batch import register_pairs
    from idam.clouds.prepared import Prepared
    from idam.many.merge import merge
    from idam.many.result import Link, MergeResult
    from idam.network.pretrained import load_model
    from idam.registration import prepare, register
    from idam.result import RegistrationResult
    from idam.weights import list_models

__all__ = [
    "InputError",
    "Link",
    "MergeResult",
    "MissingDependencyError",
    "Prepared",
    "RegistrationResult",
    "list_models",
    "load_model",
    "merge",
    "prepare",
    "register",
    "register_pairs",
]

__version__ = "0.1.0"

_LATE = {
    "Link": "idam.many.result",
    "MergeResult": "idam.many.result",
    "Prepared": "idam.clouds.prepared",
    "RegistrationResult": "idam.result",
    "list_models": "idam.weights",
    "load_model": "idam.network.pretrained",
    "merge": "idam.many.merge",
    "prepare": "idam.registration",
    "register": "idam.registration",
    "register_pairs": "idam.batch",
}


def __getattr__(name: str) -> Any:
    # imported when first used: the command line's help needs none of these, and load_model needs PyTorch
    if name not in _LATE:
        raise AttributeError(f"module 'idam' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LATE[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
