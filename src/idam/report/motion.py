"""A transform as people read it: a turn about the source's centroid, then a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.rigid import Array

__all__ = ["Motion", "motion_of"]


@dataclass(frozen=True)
class Motion:
    """p -> centroid + R (p - centroid) + shift, with R the turn by ``degrees`` about ``axis``.

    Its numbers stay small in the coordinates of a national grid, where the translation of a 4x4 has many digits: it is
    the shift of the origin, thousands of kilometres away.

    Attributes:
        centroid: of the source, (3,), in input units.
        axis: (3,), of length 1.
        degrees: 0 to 180, right-handed.
        shift: of the centroid, (3,), in input units.
    """

    centroid: Array
    axis: Array
    degrees: float
    shift: Array

    @property
    def distance(self) -> float:
        """By how much the centroid moves."""
        return float(np.linalg.norm(self.shift))

    def apply(self, points: Array) -> Array:
        """Points (N, 3) moved."""
        turn = rigid.rotation_exp(np.radians(self.degrees) * self.axis)
        return np.asarray((points - self.centroid) @ turn.T + self.centroid + self.shift)

    def written(self) -> list[tuple[str, str]]:
        """Labels and numbers with all the digits that tell: a kilometre away, 1e-9 degrees are 2e-8 metres."""
        return [
            ("centroid", " ".join(repr(value) for value in self.centroid.tolist())),
            ("axis", " ".join(f"{value + 0.0:.9f}" for value in self.axis)),
            ("degrees", f"{self.degrees:.9f}"),
            ("shift", " ".join(f"{value + 0.0:.9g}" for value in self.shift)),
        ]


def motion_of(transformation: Array, source: Array) -> Motion:
    """The motion that a transform (4, 4) is for the source's points (N, 3), finite or not."""
    centroid = source[np.isfinite(source).all(axis=1)].mean(axis=0)
    vector = rigid.rotation_log(transformation[:3, :3])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
    # R c + t - c, of terms that nearly cancel: (R - I) c first
    shift = (transformation[:3, :3] - np.eye(3)) @ centroid + transformation[:3, 3]
    return Motion(centroid, axis, float(np.degrees(angle)), shift)
