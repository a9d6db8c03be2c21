"""A method of one's own: any function of two clouds, named by its module."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError, MissingDependencyError
from idam.io.files import one_line
from idam.lab.evaluation.methods import Method
from idam.lab.settings import parsed

__all__ = ["build"]


def build(name: str, model: str | None, settings: Sequence[str]) -> Method:
    """The function ``package.module:function``, found as ``python -m`` finds it, from the current folder as well.

    It takes source (P, 3) and target (Q, 3), float32, and returns the transform (4, 4) that moves the source onto the
    target. A model, and settings, are passed on by keyword, to parameters that have defaults.

    Raises:
        InputError: there is no such function, or it does not take these.
    """
    function = _load(name)
    try:
        parameters = inspect.signature(function).parameters
        options = {key: p.default for key, p in parameters.items() if p.default is not inspect.Parameter.empty}
        chosen = parsed({key: value for key, value in options.items() if key != "model"}, settings)
        if model is not None:
            chosen["model"] = model
        inspect.signature(function).bind(None, None, **chosen)
    except TypeError as error:
        raise InputError(f"--method {name} cannot be called with source and target ({one_line(error)})") from None
    register = partial(function, **chosen)

    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        answer = np.asarray(register(source, target))
        if answer.shape != (4, 4) or answer.dtype.kind not in "iuf" or not np.isfinite(answer).all():
            raise InputError(f"--method {name} returned no transform: it must return 4 x 4 finite numbers")
        return answer.astype(np.float64)

    return run


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        function = getattr(import_module(module), attribute)
    except MissingDependencyError:
        raise
    except Exception as error:  # there is no telling what an unknown module does
        raise InputError(
            f"--method {name} cannot be imported ({type(error).__name__}: {one_line(error)}); give package.module:"
            "function, from the current folder or installed"
        ) from None
    if not callable(function):
        raise InputError(f"--method {name} is no function of source and target")
    return function
