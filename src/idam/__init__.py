"""Learned global registration of partially overlapping 3D point clouds (IDAM, ECCV 2020)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from idam.errors import InputError, MissingDependencyError
from idam.result import RegistrationResult

if TYPE_CHECKING:
    from idam.network.pretrained import list_models, load_model
    from idam.registration import register

__all__ = ["InputError", "MissingDependencyError", "RegistrationResult", "list_models", "load_model", "register"]

__version__ = "0.1.0"

_LATE = {
    "register": "idam.registration",
    "list_models": "idam.network.pretrained",
    "load_model": "idam.network.pretrained",
}


def __getattr__(name: str) -> Any:
    # these import torch, which takes seconds: only when first used
    if name not in _LATE:
        raise AttributeError(f"module 'idam' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LATE[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
