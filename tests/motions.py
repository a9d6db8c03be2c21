"""Rigid motions of points, which several tests make and apply."""

import numpy as np
from scipy.spatial.transform import Rotation


def rigid(rotation_vector: list[float], translation: np.ndarray | list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def move(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
