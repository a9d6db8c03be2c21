"""What every reader returns and every writer takes: a point cloud, a mesh, the scans of a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam import rigid
from idam.errors import InputError

__all__ = ["Mesh", "PointCloud", "Scan", "float_rows", "joined"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points, with what the file says of each.

    Attributes:
        points: (N, 3) float64 coordinates.
        colors: (N, 3) uint8 red, green, blue, or None.
        normals: (N, 3) float64, or None.
        attributes: further numbers of each point by name, (N,) each: intensity, classification, time.

    Raises:
        InputError: an array has another shape or type.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.float64] | None = None
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict, repr=False)

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
        for name, values in self.attributes.items():
            if np.shape(values) != points.shape[:1]:
                raise InputError(f"{name}: expected one number for each of {len(points):,} points")

    def transformed(self, transformation: ArrayLike) -> PointCloud:
        """Move the cloud by a rigid transform (4, 4): points move, normals turn, all else stays."""
        matrix = np.asarray(transformation, np.float64)
        normals = None if self.normals is None else self.normals @ matrix[:3, :3].T
        return replace(self, points=rigid.apply(matrix, self.points), normals=normals)

    def where(self, rows: NDArray[Any]) -> PointCloud:
        """The points of these rows, or of a mask (N,)."""
        return PointCloud(
            self.points[rows],
            None if self.colors is None else self.colors[rows],
            None if self.normals is None else self.normals[rows],
            {name: values[rows] for name, values in self.attributes.items()},
        )


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles between points.

    Attributes:
        vertices: the corners, with their colours and normals.
        faces: (F, 3) int64 rows of ``vertices``.
    """

    vertices: PointCloud
    faces: NDArray[np.int64]

    def transformed(self, transformation: ArrayLike) -> Mesh:
        """Move the mesh by a rigid transform (4, 4)."""
        return Mesh(self.vertices.transformed(transformation), self.faces)


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of a file.

    Attributes:
        name: of the file, without its folder; ``site.e57#2`` for the second scan of a file of several.
        cloud: its points, in the scanner's own frame.
        pose: (4, 4), takes them to the frame that the file's scans share; None where the file says nothing.
    """

    name: str
    cloud: PointCloud
    pose: NDArray[np.float64] | None = None

    def placed(self) -> PointCloud:
        """The points in the frame that the file's scans share."""
        return self.cloud if self.pose is None else self.cloud.transformed(self.pose)


def joined(clouds: list[PointCloud]) -> PointCloud:
    """All points as one cloud, with what every part has."""
    if len(clouds) == 1:
        return clouds[0]
    colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    names = [name for name in clouds[0].attributes if all(name in cloud.attributes for cloud in clouds)]
    return PointCloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate(colors) if len(colors) == len(clouds) else None,
        np.concatenate(normals) if len(normals) == len(clouds) else None,
        {name: np.concatenate([cloud.attributes[name] for cloud in clouds]) for name in names},
    )


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
        hint = ": transpose it" if array.ndim == 2 and array.shape[0] in (3, 4) else ""
        hint = ": give cloud.reshape(-1, 3)" if array.ndim == 3 and array.shape[2] == 3 else hint
        raise InputError(f"{name}: expected (N, 3), got shape {array.shape}{hint}")
    return array.astype(np.float64, copy=False)
