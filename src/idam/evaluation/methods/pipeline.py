"""The whole of :func:`idam.register`, refinement included."""

from __future__ import annotations

from collections.abc import Sequence

from idam.errors import InputError
from idam.evaluation.methods import Method
from idam.registration import register

__all__ = ["build"]


def build(model: str | None, settings: Sequence[str]) -> Method:
    """``idam.register`` with nothing set but the model.

    Raises:
        InputError: there is a setting: the data chooses them all.
    """
    if settings:
        raise InputError(f"unknown setting {settings[0]!r}: register takes everything from the data")
    return lambda source, target: register(source, target, model=model or "default").transformation
