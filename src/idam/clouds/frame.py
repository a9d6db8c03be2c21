"""Where a cloud is and how large, whatever strays lie around it; and whether it can be registered at all."""

from __future__ import annotations

import numpy as np

from idam.errors import InputError
from idam.rigid import Array

__all__ = ["MIN_POINTS", "check_points", "core", "without_strays"]

MIN_POINTS = 20
CORE = 0.98
"""Share of the points, those nearest to the median, that say where a cloud is and how large."""
MOST = 0.9
"""Share of the points whose distance from the median says which are strays."""
STRAY = 16.0
"""Multiple of that distance from which on a point is a stray. A LiDAR's farthest returns lie at 3 to 8 times it."""
FLATNESS = 1e-6
"""Second over first singular value of the centred cloud below which it counts as a line."""
LARGEST = 1e100
"""Coordinates past this overflow when squared and summed: as good as infinite."""


def check_points(points: Array, name: str) -> tuple[Array, float]:
    """The :func:`core` of points (N, 3); raise InputError unless they can be registered at all."""
    if len(points) < MIN_POINTS:
        raise InputError(f"{name}: has {len(points)} points, at least {MIN_POINTS} are needed; give a denser scan")
    if not np.abs(points).max() < LARGEST:  # also false for NaN
        count = int((~(np.abs(points) < LARGEST).all(1)).sum())
        raise InputError(
            f"{name}: {count} of {len(points)} points are NaN or infinite; leave them out, as in "
            "cloud[numpy.isfinite(cloud).all(axis=1)]"
        )
    centre, radius = core(points)
    # below the rounding of the coordinates themselves, differences mean nothing
    if radius <= 1e-12 * max(1.0, float(np.abs(centre).max())):
        raise InputError(f"{name}: all points are equal; nothing to register")
    centred = without_strays((points - centre) / radius, 1.0)
    spread = np.sqrt(np.clip(np.linalg.eigvalsh(centred.T @ centred), 0, None))
    if spread[1] <= FLATNESS * spread[2]:
        raise InputError(f"{name}: all points lie on a line, which leaves a rotation free; give a scan of a surface")
    return centre, radius


def core(points: Array) -> tuple[Array, float]:
    """The centre (3,) of points (N, 3) and the radius around it, without strays.

    A scanner's (0, 0, 0) for "no return", or some far points, must not shrink everything else: what lies at many times
    the distance of most points from their median does not count, nor do the 2 % of the rest that are farthest.
    """
    # columns in one piece and partitions: np.median and np.quantile of rows take six times as long
    middle = _ranked(np.ascontiguousarray(points.T), len(points) // 2)
    square = squares(points - middle)
    near = square <= STRAY**2 * _ranked(square, int(MOST * (len(points) - 1)))
    if not near.all():
        points, square = points.compress(near, axis=0), square.compress(near)
    inner = points.compress(square <= _ranked(square, int(CORE * (len(points) - 1))), axis=0)
    # sums of coordinates as large as UTM's would lose their last digits
    centre = middle + np.ascontiguousarray((inner - middle).T).mean(1)
    return centre, float(np.sqrt(squares(inner - centre).max()))


def without_strays(points: Array, radius: float) -> Array:
    """Points (N, 3) about the origin without those far from everything else."""
    return points.compress(squares(points) < (STRAY * radius) ** 2, axis=0)


def squares(points: Array) -> Array:
    """The squared distance (N,) of each point from the origin."""
    result: Array = np.einsum("ij,ij->i", points, points)
    return result


def _ranked(values: Array, rank: int) -> Array:
    """The value of a rank, from 0, along the last axis (..., N), (...)."""
    ranked: Array = np.partition(values, rank)[..., rank]
    return ranked
