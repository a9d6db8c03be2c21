"""How well a transform explains two clouds, as far as they overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from idam.refine import Refinable

__all__ = ["Agreement", "agreement", "inliers"]

Points = NDArray[np.float64]

SAME_SURFACE = 0.7
"""|cosine| of the normals from which two near points count as the same surface (45 degrees)."""


@dataclass(frozen=True)
class Agreement:
    """The overlap of two clouds under a transform.

    Attributes:
        source_share: share of source points that lie on the target: near it, with like normals.
        target_share: share of target points that lie on the source.
    """

    source_share: float
    target_share: float

    @property
    def score(self) -> float:
        """The geometric mean, which is high only where both clouds are explained."""
        return float(np.sqrt(self.source_share * self.target_share))


def agreement(source: Refinable, target: Refinable, transformation: Points, distance: float) -> Agreement:
    """Overlap of the clouds under a transform (4, 4), at ``distance``; the same when the two are swapped."""
    rotation = transformation[:3, :3]
    moved = source.points @ rotation.T + transformation[:3, 3]
    normals = source.normals @ rotation.T
    return Agreement(
        _share_on(moved, normals, target.points, target.normals, distance),
        _share_on(target.points, target.normals, moved, normals, distance),
    )


def _share_on(points: Points, normals: Points, others: Points, other_normals: Points, distance: float) -> float:
    found, index = cKDTree(others).query(points, distance_upper_bound=distance)
    near = np.isfinite(found)
    cosine = np.abs((normals[near] * other_normals[index[near]]).sum(1))
    return float((cosine >= SAME_SURFACE).sum() / len(points))


def inliers(moved: Points, target: Points, distance: float) -> tuple[NDArray[np.int64], float]:
    """Pairs (C, 2) of rows of the moved source and the target within ``distance``, and their RMSE (0 for no pairs)."""
    found, index = cKDTree(target).query(moved, distance_upper_bound=distance, workers=-1)
    rows = np.flatnonzero(np.isfinite(found))
    rmse = float(np.sqrt(np.mean(found[rows] ** 2))) if len(rows) else 0.0
    return np.stack([rows, index[rows]], 1).astype(np.int64), rmse
