"""Unit quaternions, w first, and the rotations they stand for."""

from __future__ import annotations

import numpy as np

from idam import rigid

__all__ = ["quaternion", "rotation"]


def rotation(quaternion: rigid.Array) -> rigid.Array:
    """The rotation (3, 3) of a quaternion (4,) w x y z, which need not be quite of length 1.

    Raises:
        ValueError: its length is 0 or not finite.
    """
    length = np.linalg.norm(quaternion)
    if not 0 < length < np.inf:
        raise ValueError("a quaternion of length 0")
    w, vector = quaternion[0] / length, quaternion[1:] / length
    cross = rigid.skew(vector)
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def quaternion(rotation: rigid.Array) -> rigid.Array:
    """The quaternion (4,) w x y z of a rotation (3, 3), w not negative."""
    vector = rigid.rotation_log(rotation)
    half = np.linalg.norm(vector) / 2
    return np.array([np.cos(half), *(vector / 2 * np.sinc(half / np.pi))])
