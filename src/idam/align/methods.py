"""The fine alignments by name, and how far each reaches."""

from __future__ import annotations

import numpy as np

from idam.align.symmetric import symmetric_icp
from idam.clouds.surfaces import Surfaces
from idam.errors import InputError
from idam.rigid import Array

__all__ = ["METHODS", "align", "copies", "reaches", "refine"]

SMALL_GICP = {"gicp": "GICP", "plane": "PLANE_ICP", "point": "ICP"}
METHODS = (*SMALL_GICP, "symmetric")
"""Fine alignments: generalised ICP, point to plane (as small_gicp has it: each coordinate of the distance times the
normal's, rather than their inner product), point to point, and symmetric (:mod:`idam.align.symmetric`)."""
REACHES = {"symmetric": (3.5, 2.5)}
"""Spacings within which points pull on each other at first and at last, by method; where they are not given, 1, since a
longer reach draws right answers of little overlap away, and 2."""
COPIES = 0.7
"""Median distance of points that lie on each other, in spacings, below which they are copies of the same points."""
FEWEST = 10
"""Inliers below which small_gicp's answer is chance."""


def reaches(method: str) -> tuple[float, float]:
    """Spacings within which points pull on each other, at first and at last."""
    return REACHES.get(method, (1.0, 2.0))


def refine(surfaces: Surfaces, start: Array, distance: float, method: str = "gicp", iterations: int = 30) -> Array:
    """Improve a transform (4, 4) that is nearly right.

    Args:
        surfaces: in working coordinates, about the unit sphere: the tolerances count on it.
        start: where to begin.
        distance: points further apart do not pull on each other, in working units.
        method: one of :data:`METHODS`.
        iterations: at most.

    Returns:
        The transform (4, 4): the start where nothing lies within ``distance`` or the solution is not finite.

    Raises:
        InputError: the method is unknown.
    """
    import small_gicp

    if method not in METHODS:
        raise InputError(f"unknown refinement {method!r}: choose {', '.join(METHODS)} or none")
    if method == "symmetric":
        return symmetric_icp(surfaces, start, distance, iterations)
    result = small_gicp.align(
        surfaces.target.cloud,
        surfaces.source.cloud,
        surfaces.target.tree,
        start,
        registration_type=SMALL_GICP[method],
        max_correspondence_distance=distance,
        num_threads=1,
        max_iterations=iterations,
        rotation_epsilon=1e-5,
        translation_epsilon=1e-6,
    )
    transformation = np.asarray(result.T_target_source)
    if result.num_inliers < FEWEST or not np.isfinite(transformation).all():
        return start
    return transformation


def align(surfaces: Surfaces, start: Array, reach: float, method: str, iterations: int = 30) -> Array:
    """:func:`refine` as :func:`idam.register` does it: lengths in spacings, and copies of points laid on each other.

    In the paper's protocol most points are copies of the other cloud's, and their distance shows it once they are laid
    on each other, point to point. Scans of one surface have no point in common, and are aligned symmetrically.

    Args and result as of :func:`refine`, but for ``reach``, the distance in spacings, and the method ``none``, which
    ends where it starts.
    """
    if method == "none":
        return start
    if method == "symmetric":
        points = refine(surfaces, start, surfaces.spacing, "point", 100)
        if copies(surfaces, points):
            return points
    return refine(surfaces, start, reach * surfaces.spacing, method, iterations)


def copies(surfaces: Surfaces, transformation: Array) -> bool:
    """Whether the source points that a transform lays on the target lie as near as copies do."""
    distance, _, _ = surfaces.touching(transformation)
    return len(distance) > 0 and bool(np.median(distance) < COPIES * surfaces.spacing)
