"""How much of two clouds a transform lays on each other."""

from __future__ import annotations

from idam import rigid
from idam.clouds.surfaces import TOUCHING, Surfaces
from idam.rigid import Array

__all__ = ["overlap"]


def overlap(surfaces: Surfaces, transformation: Array, reach: float = TOUCHING) -> float:
    """The geometric mean of the shares of either cloud's points that lie on the other, in [0, 1].

    A point lies on the nearest one of the other cloud, within ``reach`` spacings, where their normals agree. The mean
    is high only where both clouds are explained.
    """
    mine, _ = surfaces.alike(transformation, reach)
    theirs, _ = surfaces.swapped().alike(rigid.inverse(transformation), reach)
    shares = len(mine) / len(surfaces.source.points), len(theirs) / len(surfaces.target.points)
    return float((shares[0] * shares[1]) ** 0.5)
