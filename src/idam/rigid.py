"""Rigid transforms in NumPy, as 4x4 matrices, batched over any leading shape ``...``.

Column vectors: a transform T (..., 4, 4) takes a point p to R p + t, which for points stored as rows is
``points @ R^T + t``. Rotations are right-handed. ``T_target_source`` takes source coordinates to target coordinates. A
twist (..., 6) is a rotation vector in radians and then a translation; it perturbs from the right, T exp(x), as GTSAM's
``Pose3`` has it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Array",
    "Rows",
    "adjoint",
    "angle",
    "apply",
    "carried",
    "exp",
    "inverse",
    "log",
    "nearest_rotation",
    "rotation_exp",
    "rotation_log",
    "skew",
    "transform",
]

Array = NDArray[np.float64]
"""Coordinates and matrices: float64 everywhere but inside the descriptor."""
Rows = NDArray[np.int64]
"""Row numbers of points."""

SMALL = 1e-4
"""Radians below which series replace quotients whose terms cancel: the next term is below rounding there."""


def transform(rotation: Any, translation: Any) -> Array:
    """The transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    matrix = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, translation, 1.0
    return matrix


def apply(matrix: Array, points: Array) -> Array:
    """Points (..., N, 3) moved by transforms (..., 4, 4)."""
    moved: Array = points @ matrix[..., :3, :3].swapaxes(-1, -2) + matrix[..., None, :3, 3]
    return moved


def inverse(matrix: Array) -> Array:
    """The inverses of rigid transforms (..., 4, 4)."""
    rotation = matrix[..., :3, :3].swapaxes(-1, -2)
    return transform(rotation, -(rotation @ matrix[..., :3, 3:])[..., 0])


def angle(rotation: Array) -> Array:
    """The angles in radians (...) of rotations (..., 3, 3), accurate near 0 and near pi.

    Also of transforms (..., 4, 4), whose translation plays no part.
    """
    rotation = rotation[..., :3, :3]
    sine = np.linalg.norm(_axis(rotation), axis=-1)
    return np.asarray(np.arctan2(sine, np.trace(rotation, axis1=-2, axis2=-1) - 1.0))


def skew(vector: Array) -> Array:
    """The matrices [v] (..., 3, 3) of vectors (..., 3) with [v] w = v x w."""
    matrix = np.zeros((*vector.shape, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = x, y, z
    matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1] = -x, -y, -z
    return matrix


def rotation_exp(vector: Array) -> Array:
    """The rotations (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    a, b, _ = _coefficients(vector)
    cross = skew(vector)
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)


def rotation_log(rotation: Array) -> Array:
    """The rotation vectors (..., 3) in radians of rotations (..., 3, 3), up to pi long."""
    turned = angle(rotation)[..., None]
    axis = _axis(rotation)
    # near pi the axis comes from the symmetric part, R + R^T - (tr R - 1) I = 2 (1 - cos) a a^T
    symmetric = rotation + rotation.swapaxes(-1, -2)
    symmetric = symmetric - (np.trace(rotation, axis1=-2, axis2=-1) - 1.0)[..., None, None] * np.eye(3)
    column = np.argmax(np.diagonal(symmetric, axis1=-2, axis2=-1), axis=-1)
    far = np.take_along_axis(symmetric, column[..., None, None], -1)[..., 0]
    far = far * np.where((far * axis).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    near = np.where(turned < SMALL, 0.5 + turned**2 / 12, turned / _not_zero(2 * np.sin(turned)))
    length = _not_zero(np.linalg.norm(far, axis=-1, keepdims=True))
    return np.asarray(np.where(turned > np.pi - 1e-2, turned * far / length, near * axis))


def exp(twist: Array) -> Array:
    """The transforms (..., 4, 4) of twists (..., 6)."""
    vector = twist[..., :3]
    _, b, c = _coefficients(vector)
    cross = skew(vector)
    carried = np.eye(3) + b * cross + c * cross @ cross
    return transform(rotation_exp(vector), (carried @ twist[..., 3:, None])[..., 0])


def log(matrix: Array) -> Array:
    """The twists (..., 6) of transforms (..., 4, 4), rotations up to pi."""
    vector = rotation_log(matrix[..., :3, :3])
    _, b, c = _coefficients(vector)
    cross = skew(vector)
    carried = np.eye(3) + b * cross + c * cross @ cross
    return np.concatenate([vector, np.linalg.solve(carried, matrix[..., :3, 3:])[..., 0]], -1)


def adjoint(matrix: Array) -> Array:
    """The matrices Ad (..., 6, 6) with T exp(x) = exp(Ad x) T, of transforms T (..., 4, 4)."""
    rotation = matrix[..., :3, :3]
    full = np.zeros((*matrix.shape[:-2], 6, 6))
    full[..., :3, :3] = full[..., 3:, 3:] = rotation
    full[..., 3:, :3] = skew(matrix[..., :3, 3]) @ rotation
    return full


def carried(information: Array, change: Array) -> Array:
    """An information matrix (6, 6) of a twist x, as that of the twist y = C x, with ``change`` C (6, 6)."""
    back = np.linalg.inv(change)
    result = back.T @ information @ back
    return np.asarray((result + result.T) / 2)


def nearest_rotation(matrix: Array) -> Array:
    """The rotations nearest to matrices (..., 3, 3) that are nearly rotations, as rounding or few digits leave them."""
    u, _, vh = np.linalg.svd(matrix)
    return np.asarray(u @ vh)


def _axis(rotation: Array) -> Array:
    """Twice the sine times the axis of rotations (..., 3, 3): (..., 3)."""
    lower = [rotation[..., 2, 1], rotation[..., 0, 2], rotation[..., 1, 0]]
    upper = [rotation[..., 1, 2], rotation[..., 2, 0], rotation[..., 0, 1]]
    return np.stack(lower, -1) - np.stack(upper, -1)


def _coefficients(vector: Array) -> tuple[Array, Array, Array]:
    """sin(x) / x, (1 - cos(x)) / x^2 and (x - sin(x)) / x^3 of the lengths x of vectors (..., 3), each (..., 1, 1)."""
    x = np.linalg.norm(vector, axis=-1)[..., None, None]
    safe = np.where(x < SMALL, 1.0, x)
    a = np.where(x < SMALL, 1 - x**2 / 6, np.sin(safe) / safe)
    b = np.where(x < SMALL, 0.5 - x**2 / 24, 2 * (np.sin(safe / 2) / safe) ** 2)
    c = np.where(x < SMALL, 1 / 6 - x**2 / 120, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def _not_zero(x: Array) -> Array:
    return np.where(x == 0.0, 1.0, x)
