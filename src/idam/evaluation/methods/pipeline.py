"""The whole of :func:`idam.register`, refinement included."""

from __future__ import annotations

from idam.evaluation.methods import Method
from idam.registration import register

__all__ = ["build"]


def build(model: str | None) -> Method:
    """``idam.register`` with nothing set but the model."""
    return lambda source, target: register(source, target, model=model or "default").transformation
