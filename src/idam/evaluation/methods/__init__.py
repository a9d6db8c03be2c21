"""The rows of the tables: methods that register one pair, by name, imported when first asked for."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError

__all__ = ["METHODS", "Method", "build_method"]

Method = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float64]]
"""Source (P, 3) and target (Q, 3) to the transform (4, 4) that lays the source on the target."""

METHODS = {
    "gnn-idam": "idam.evaluation.methods.network:gnn",
    "fpfh-idam": "idam.evaluation.methods.network:fpfh",
    "register": "idam.evaluation.methods.pipeline:build",
}
"""Where the function is that makes each method from the name of a model (or None for its own choice)."""


def build_method(name: str, model: str | None = None) -> Method:
    """The method of that name, with the named weights where it has any.

    Raises:
        InputError: no method has that name, or no model has that.
    """
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}: choose {', '.join(METHODS)}")
    module, function = METHODS[name].split(":")
    method: Method = getattr(import_module(module), function)(model)
    return method
