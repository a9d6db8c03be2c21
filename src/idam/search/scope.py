"""Scope: how far from a guess transforms are looked into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.rigid import Array

__all__ = ["Scope"]

ROUNDING = 1e-9
"""Radians by which rounding may take a transform out of its scope."""


@dataclass(frozen=True)
class Scope:
    """The transforms that turn by no more than so much from a guess.

    Attributes:
        guess: (4, 4).
        max_angle: degrees.
        given: whether the caller gave the guess, so that it is an answer to consider.
    """

    guess: Array
    max_angle: float = 180.0
    given: bool = False

    def within(self, transformations: Array) -> Array:
        """Those of the transforms (S, 4, 4) that are in the scope."""
        held: Array = transformations[self.turned(transformations) <= np.radians(self.max_angle) + ROUNDING]
        return held

    def around(self, transformation: Array, max_angle: float) -> Scope:
        """A scope of ``max_angle`` about one of this scope's transforms, or of less, so that it lies in this one."""
        left = self.max_angle - float(np.degrees(self.turned(transformation)))
        return Scope(transformation, min(max_angle, left))

    def turned(self, transformations: Array) -> Array:
        """Radians (...) from the guess to transforms (..., 4, 4)."""
        return rigid.angle(self.guess[:3, :3].T @ transformations[..., :3, :3])
