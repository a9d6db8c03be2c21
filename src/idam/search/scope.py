"""Scope: how far from a guess transforms are looked into."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.network.geometry import rotation_angle
from idam.search.ranking import Answer

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
        given = list(transformations)
        if not given:
            return []
        held = self._holds(torch.as_tensor(np.stack(given)[:, :3, :3]))
        return [Answer(given[n]) for n in held.nonzero().flatten().tolist()]

    def turns(self, rotations: Tensor) -> Tensor:
        """Those of the rotations (n, 3, 3), each after the guess's, that are in the scope."""
        turned = rotations @ torch.as_tensor(self.guess[:3, :3], dtype=rotations.dtype)
        return turned[self._holds(turned)]

    def around(self, transformation: Points, max_angle: float) -> Scope:
        """A scope of ``max_angle`` about one of this scope's transforms, or of less, so that it lies in this one."""
        turned = float(self._degrees(torch.as_tensor(transformation[:3, :3])))
        return Scope(transformation, min(max_angle, self.max_angle - turned))

    def _holds(self, rotations: Tensor) -> Tensor:
        """Whether each rotation (n, 3, 3) is in the scope, (n,)."""
        return self._degrees(rotations) <= self.max_angle + ROUNDING

    def _degrees(self, rotations: Tensor) -> Tensor:
        """Degrees from the guess to each rotation (..., 3, 3)."""
        return rotation_angle(torch.as_tensor(self.guess[:3, :3]).T @ rotations.double())
