"""What the data fix of a transform, and what they leave free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surfaces
from idam.rigid import Array
from idam.search.slides import slippage

__all__ = ["Strength", "strength"]


@dataclass(frozen=True, eq=False)
class Strength:
    """How firmly the surfaces that lie on each other hold the transform T, along each of six motions T exp(s x).

    Attributes:
        motions: (6, 6), twists x in the source's frame, rotation in radians before translation in input units, the
            least firmly held first. Each moves the shared points by one input unit in the root mean square.
        fixed: (6,), the share of each motion's mean square that goes along the normals, in [0, 1]: next to none of a
            slide along a wall, most of a push against it. A corridor's scans have 0.002 to 0.03 along it, for noise.
    """

    motions: Array
    fixed: Array

    def carried(self, change: Array) -> Strength:
        """With motions y = C x, ``change`` C (6, 6)."""
        return Strength(self.motions @ change.T, self.fixed)


def strength(surfaces: Surfaces, transformation: Array) -> Strength:
    """How firmly surfaces in working coordinates hold a transform (4, 4); all free where too little is shared."""
    fixed, motions, centre = slippage(surfaces, transformation)
    if len(fixed) == 0:
        return Strength(np.eye(6), np.zeros(6))
    # exp(m) about the centre, in the target's frame, is T exp(x) T^-1
    to_source = rigid.adjoint(rigid.inverse(transformation)) @ rigid.adjoint(rigid.transform(np.eye(3), centre))
    return Strength(motions @ to_source.T, fixed.clip(0, 1))
