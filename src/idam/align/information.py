"""How precisely a transform is known: its information matrix, and the covariance."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.clouds.surfaces import Surfaces
from idam.rigid import Array

__all__ = ["information"]


def information(surfaces: Surfaces, transformation: Array) -> Array:
    """The information matrix (6, 6) of a transform (4, 4): the inverse of its covariance, in working units.

    Of T exp(x), rotation before translation. Zero where too little lies on each other to tell.
    """
    _, mine, theirs = surfaces.touching(transformation)
    if len(mine) < 12:
        return np.zeros((6, 6))
    points = surfaces.source.points[mine]
    normals = surfaces.target.normals[theirs]
    residual = ((rigid.apply(transformation, points) - surfaces.target.points[theirs]) * normals).sum(1)
    along = normals @ transformation[:3, :3]
    gradient = np.concatenate([np.cross(points, along), along], 1)
    scale = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    weight = 1.0 / max(scale, 1e-9) ** 2
    return np.asarray(weight * gradient.T @ gradient)
