"""The whole of :func:`idam.register`, refinement included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from idam.lab.evaluation.methods import Method
from idam.lab.settings import with_settings
from idam.registration import register

__all__ = ["Settings", "build"]


@dataclass(frozen=True)
class Settings:
    """What a row may set; the data chooses all else.

    Attributes:
        max_angle: degrees that a pair may be turned.
    """

    max_angle: float = 180.0


def build(model: str | None, settings: Sequence[str]) -> Method:
    """``idam.register`` with nothing set but the model, and the largest angle for those who know one."""
    largest = with_settings(Settings(), settings).max_angle
    return lambda source, target: register(source, target, model=model or "default", max_angle=largest).transformation
