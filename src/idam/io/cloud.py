"""The point cloud every reader returns and every writer takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam.errors import InputError

__all__ = ["PointCloud", "float_rows"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points, with a colour and a normal each where the file has them.

    Attributes:
        points: (N, 3) float64 coordinates.
        colors: (N, 3) uint8 red, green, blue, or None.
        normals: (N, 3) float64, or None.

    Raises:
        InputError: an array has another shape or type.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        points = float_rows(self.points, "points")
        object.__setattr__(self, "points", points)
        if self.colors is not None:
            colors = np.asarray(self.colors)
            if colors.dtype != np.uint8 or colors.shape != points.shape:
                raise InputError(f"colours: expected uint8 {points.shape}, got {colors.dtype} {colors.shape}")
            object.__setattr__(self, "colors", colors)
        if self.normals is not None:
            normals = float_rows(self.normals, "normals")
            if normals.shape != points.shape:
                raise InputError(f"normals: expected one for each point, {points.shape}, got {normals.shape}")
            object.__setattr__(self, "normals", normals)

    def transformed(self, transformation: ArrayLike) -> PointCloud:
        """Move the cloud by a rigid transform (4, 4): points move, normals turn, colours stay."""
        matrix = np.asarray(transformation, np.float64)
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
        normals = None if self.normals is None else self.normals @ rotation.T
        return PointCloud(self.points @ rotation.T + translation, self.colors, normals)


def float_rows(data: Any, name: str) -> NDArray[np.float64]:
    """Turn ``data`` into a float64 (N, 3) array; not copied if it is one already.

    Raises:
        InputError: it has another shape, or does not hold real numbers.
    """
    try:
        array = np.asarray(data)
    except (ValueError, TypeError) as error:
        raise InputError(f"{name}: expected (N, 3), got rows of unequal length or no numbers at all") from error
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name}: expected (N, 3) real numbers, got {array.dtype} of shape {array.shape}")
    if array.ndim != 2 or array.shape[1] != 3:
        hint = ": transpose it" if array.ndim == 2 and array.shape[0] == 3 else ""
        raise InputError(f"{name}: expected (N, 3), got shape {array.shape}{hint}")
    return array.astype(np.float64, copy=False)
