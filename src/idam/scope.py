"""Scope: how far from a guess transforms are looked into."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.ranking import Answer

__all__ = ["Scope"]

Points = NDArray[np.float64]

ROUNDING = 1e-3
"""Degrees by which single precision may take a transform out of its scope."""


@dataclass(frozen=True)
class Scope:
    """The transforms that turn by no more than so much from a guess.

    Attributes:
        guess: (4, 4).
        max_angle: degrees.
    """

    guess: Points
    max_angle: float = 180.0

    def within(self, transformations: Iterable[Points]) -> list[Answer]:
        """The transforms (4, 4) that are in the scope, as answers."""
        return [Answer(x) for x in transformations if self._angle(x[:3, :3]) <= self.max_angle + ROUNDING]

    def turns(self, rotations: Tensor) -> Tensor:
        """Those of the rotations (n, 3, 3), each after the guess's, that are in the scope."""
        turned = rotations @ torch.as_tensor(self.guess[:3, :3], dtype=rotations.dtype)
        within = [self._angle(rotation) <= self.max_angle + ROUNDING for rotation in turned.double().numpy()]
        return turned[torch.tensor(within)]

    def around(self, transformation: Points, max_angle: float) -> Scope:
        """A scope of ``max_angle`` about one of this scope's transforms, or of less, so that it lies in this one."""
        return Scope(transformation, min(max_angle, self.max_angle - self._angle(transformation[:3, :3])))

    def _angle(self, rotation: Points) -> float:
        """Degrees from the guess to a rotation (3, 3); unlike the arc cosine of a trace, exact for small ones."""
        apart = np.linalg.norm(self.guess[:3, :3] - rotation) / math.sqrt(8)
        return math.degrees(2 * math.asin(min(apart, 1.0)))
