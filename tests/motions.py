"""Rigid motions of points, which several tests make and apply; written apart from :mod:`idam.rigid`."""

import numpy as np


def rotation(vector: list[float] | np.ndarray) -> np.ndarray:
    """The rotation (3, 3) by a rotation vector in radians."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector, float) / angle
    axis = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.cos(angle) * np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * np.outer(axis, axis)


def rigid(rotation_vector: list[float] | np.ndarray, translation: np.ndarray | list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(rotation_vector)
    matrix[:3, 3] = translation
    return matrix


def move(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between the rotations of two transforms, accurate for small ones."""
    chord = np.linalg.norm(a[:3, :3] - b[:3, :3])  # 2 sqrt(2) sin(angle / 2)
    return float(np.degrees(2 * np.arcsin(min(1.0, chord / 8**0.5))))


def any_rotation(random: np.random.Generator) -> np.ndarray:
    """A rotation (3, 3), all equally likely."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)
