"""Fine alignment: small_gicp's, and a symmetric one for sparse clouds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from idam.align.symmetric import symmetric_icp
from idam.errors import InputError

__all__ = ["METHODS", "TOUCHING", "Refinable", "Surfaces", "align", "reaches", "refine"]

Points = NDArray[np.float64]

SMALL_GICP = {"gicp": "GICP", "plane": "PLANE_ICP", "point": "ICP"}
METHODS = (*SMALL_GICP, "symmetric")
"""Fine alignments: generalised ICP, point to plane (as small_gicp has it: each coordinate of the distance times the
normal's, rather than their inner product), point to point, and symmetric (:mod:`idam.align.symmetric`)."""
REACHES = {"symmetric": (3.5, 2.5)}
"""Spacings within which points pull on each other at first and at last, by method; where they are not given, 1, since a
longer reach draws right answers of little overlap away, and 2."""
TOUCHING = 1.5
"""Spacings within which a transform makes two points one."""
COPIES = 0.7
"""Median distance of points that lie on each other, in spacings, below which they are copies of the same points."""

NEIGHBOURS = 15
"""Points that each normal and covariance is estimated from."""


@dataclass(frozen=True)
class Refinable:
    """A cloud with what fine alignment and scoring need of it, made once: normals, covariances and search trees.

    Attributes:
        cloud: small_gicp's.
        tree: small_gicp's.
    """

    cloud: Any
    tree: Any

    @classmethod
    def build(cls, points: Points) -> Refinable:
        """From points (N, 3) in working coordinates."""
        import small_gicp

        cloud = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(cloud)
        # each point for itself, so that the number of threads changes no bit
        small_gicp.estimate_normals_covariances(
            cloud, tree, num_neighbors=min(NEIGHBOURS, len(points)), num_threads=torch.get_num_threads()
        )
        return cls(cloud, tree)

    @cached_property
    def points(self) -> Points:
        """(N, 3)."""
        return np.ascontiguousarray(self.cloud.points()[:, :3])

    @cached_property
    def normals(self) -> Points:
        """(N, 3), of either sign."""
        return np.ascontiguousarray(self.cloud.normals()[:, :3])

    @cached_property
    def search(self) -> cKDTree:
        """A tree of the points that answers many queries in one call, which ``tree`` takes one by one from Python."""
        return cKDTree(self.points)


@dataclass(frozen=True)
class Surfaces:
    """Two clouds to be laid on each other, in working coordinates, and the spacing of their points."""

    source: Refinable
    target: Refinable
    spacing: float

    def to_target(self, transformation: Points) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """What the source's N points lie on under a transform (..., 4, 4).

        Returns:
            The distance (..., N) to the nearest target point, infinite past :data:`TOUCHING` spacings, and its row.
        """
        rotation, translation = transformation[..., :3, :3], transformation[..., None, :3, 3]
        moved = self.source.points @ rotation.swapaxes(-1, -2) + translation
        distance, row = self.target.search.query(moved, distance_upper_bound=TOUCHING * self.spacing)
        return distance, row


def refine(
    source: Refinable, target: Refinable, start: Points, distance: float, method: str = "gicp", iterations: int = 30
) -> tuple[Points, NDArray[np.float64]]:
    """Improve a transform (4, 4) that is nearly right.

    Args:
        source: in working coordinates, about the unit sphere: the tolerances count on it.
        target: likewise.
        start: where to begin.
        distance: points further apart do not pull on each other.
        method: one of :data:`METHODS`.
        iterations: at most.

    Returns:
        The transform (4, 4), and the information matrix (6, 6), rotation before translation. Where nothing lies within
        ``distance`` or the solution is not finite, the start and zeros.

    Raises:
        InputError: the method is unknown.
    """
    import small_gicp

    if method not in METHODS:
        raise InputError(f"unknown refinement {method!r}: choose {', '.join(METHODS)} or none")
    if method == "symmetric":
        return symmetric_icp(source, target, start, distance, iterations)
    result = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        start,
        registration_type=SMALL_GICP[method],
        max_correspondence_distance=distance,
        num_threads=1,
        max_iterations=iterations,
        rotation_epsilon=1e-5,
        translation_epsilon=1e-6,
    )
    transformation = np.asarray(result.T_target_source)
    if result.num_inliers < 10 or not np.isfinite(transformation).all():
        return start, np.zeros((6, 6))
    return transformation, np.asarray(result.H)


def reaches(method: str) -> tuple[float, float]:
    """Spacings within which points pull on each other, at first and at last."""
    return REACHES.get(method, (1.0, 2.0))


def align(
    surfaces: Surfaces, start: Points, reach: float, method: str, iterations: int = 30
) -> tuple[Points, NDArray[np.float64]]:
    """:func:`refine` as :func:`idam.register` does it: lengths in spacings, and copies of points laid on each other.

    In the paper's protocol most points are copies of the other cloud's, and their distance shows it once they are laid
    on each other, point to point. Scans of one surface have no point in common, and are aligned symmetrically.

    Args and result as of :func:`refine`, but for ``reach``, the distance in spacings, and the method ``none``, which
    ends where it starts.
    """
    if method == "none":
        return start, np.zeros((6, 6))
    if method == "symmetric":
        points, information = refine(surfaces.source, surfaces.target, start, surfaces.spacing, "point", 100)
        if _copies(surfaces, points):
            return points, information
    return refine(surfaces.source, surfaces.target, start, reach * surfaces.spacing, method, iterations)


def _copies(surfaces: Surfaces, transformation: Points) -> bool:
    """Whether the source points that a transform lays on the target lie as near as copies do."""
    distance, _ = surfaces.to_target(transformation)
    touching = distance[np.isfinite(distance)]
    return len(touching) > 0 and bool(np.median(touching) < COPIES * surfaces.spacing)
