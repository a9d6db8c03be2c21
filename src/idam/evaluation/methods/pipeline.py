"""The whole of :func:`idam.register`, refinement included."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from idam.errors import InputError
from idam.evaluation.methods import Method
from idam.registration import register

__all__ = ["anyhow", "within_a_right_angle"]


def anyhow(model: str | None, settings: Sequence[str]) -> Method:
    """``idam.register``, which lays scans on each other however they are turned."""
    return _build(model, settings, 180.0)


def within_a_right_angle(model: str | None, settings: Sequence[str]) -> Method:
    """``idam.register``, told that nothing turns by more than 90 degrees: three angles of up to 45 make at most 86."""
    return _build(model, settings, 90.0)


def _build(model: str | None, settings: Sequence[str], max_angle: float) -> Method:
    """``idam.register`` with nothing else set but the model.

    Raises:
        InputError: there is a setting: the data chooses them all.
    """
    if settings:
        raise InputError(f"unknown setting {settings[0]!r}: register takes everything from the data")
    whole = partial(register, model=model or "default", max_angle=max_angle)
    return lambda source, target: whole(source, target).transformation
