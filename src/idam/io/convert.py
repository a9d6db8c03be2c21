"""Whatever a caller has in hand, as a point cloud."""

from __future__ import annotations

import os
import sys
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import Mesh, PointCloud, float_rows
from idam.io.columns import finite, log, named_cloud, unnamed_cloud
from idam.io.formats import read_point_cloud
from idam.io.mesh import mesh_or_cloud, sample_surface, triangles
from idam.io.pcd import unpack_colors

__all__ = ["as_point_cloud"]

WIDEST = 64
"""Columns up to which an array of more than three counts as rows of points: scanners' exports have up to a dozen."""


def as_point_cloud(data: Any, *, nan: Literal["keep", "drop"] = "keep") -> PointCloud:
    """Make a point cloud of a path, an array or another library's object.

    Masked rows are left out, and the invalid ones of a ROS message.

    Args:
        data: a path; a :class:`PointCloud`; an array (N, 3), or (N, 4 and more) whose first three columns are x, y
            and z; a structured array or a pandas or polars frame with columns that name them; a nested list; a PyTorch
            tensor on any device; a point cloud or mesh of Open3D (legacy or tensor), trimesh or PyVista, a laspy
            ``LasData``, or a ROS ``PointCloud2`` message. A mesh is sampled as a mesh file is.
        nan: whether points with NaN or infinite coordinates stay in an array, or are left out as in files.

    Raises:
        InputError: the file cannot be read, or the object holds no points of real numbers.
    """
    cloud = _as_point_cloud(data)
    return finite(cloud) if nan == "drop" else cloud


def _as_point_cloud(data: Any) -> PointCloud:
    if isinstance(data, PointCloud):
        return data
    if isinstance(data, Mesh):
        return sample_surface(data)
    if isinstance(data, str | os.PathLike):
        return read_point_cloud(data)
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(data, torch.Tensor):
        return _from_array(_from_tensor(data))
    if isinstance(data, np.ma.MaskedArray):
        return _from_masked(data)
    if all(hasattr(data, name) for name in ("fields", "point_step", "is_bigendian", "data")):
        return _from_ros(data)
    known = _from_library(data)
    if known is not None:
        return known
    if hasattr(data, "__array__") or isinstance(data, list | tuple):
        return _from_array(data)
    raise InputError(
        f"cannot find points in a {type(data).__name__}: expected (N, 3): pass a path, an array, a tensor, "
        "a data frame, or a cloud of Open3D, trimesh or PyVista"
    )


def _from_array(data: Any) -> PointCloud:
    try:
        array = np.asarray(data)
    except (ValueError, TypeError):
        array = None
    if array is not None and array.dtype.names is not None:
        names = [name for name in array.dtype.names if array.dtype[name].kind in "iufb"]
        return named_cloud({name: array[name].reshape(-1) for name in names})
    if array is not None and array.dtype.kind in "iuf" and _is_long(array):
        return unnamed_cloud(array)
    return PointCloud(float_rows(data if array is None else array, "points"))


def _is_long(array: NDArray[Any]) -> bool:
    """Whether it has rows of more than three columns: one that is wider than long lies on its side."""
    return array.ndim == 2 and 3 < array.shape[1] <= min(WIDEST, len(array) - 1)


def _from_masked(data: Any) -> PointCloud:
    if data.dtype.names is not None:
        rows = ~np.any([np.ma.getmaskarray(data[name]) for name in data.dtype.names], axis=0)
        return _from_array(data.data[rows])
    cloud = _from_array(data.data)
    rows = np.asarray(~np.ma.getmaskarray(data)[:, :3].any(axis=1))
    if not rows.all():
        log.info("left out %s masked points", f"{np.count_nonzero(~rows):,}")
    return cloud if rows.all() else cloud.where(rows)


def _from_tensor(tensor: Any) -> Any:
    """Turn a PyTorch or Open3D tensor into an array."""
    try:
        if hasattr(tensor, "detach"):
            tensor = tensor.detach()
            tensor = tensor.double() if tensor.is_floating_point() else tensor  # NumPy has no bfloat16
        return tensor.cpu().numpy()
    except (RuntimeError, TypeError, NotImplementedError) as error:
        raise InputError("tensor: expected (N, 3) dense real numbers: convert it to a NumPy array first") from error


def _from_library(data: Any) -> PointCloud | None:
    """Take the points of another library's object; None if it is of none that is known."""
    libraries = {base.__module__.partition(".")[0] for base in type(data).__mro__}
    if libraries & {"pandas", "polars"} and hasattr(data, "columns"):
        return _from_frame(data)
    if "open3d" in libraries:
        return _from_open3d(data)
    if "trimesh" in libraries and hasattr(data, "faces"):
        return _from_faces(data.vertices, np.asarray(data.faces, np.int64))
    if "trimesh" in libraries and hasattr(data, "vertices"):
        return _with_extras(data.vertices, getattr(data, "colors", None), None)
    if "pyvista" in libraries and hasattr(data, "points"):
        return _from_pyvista(data)
    if "laspy" in libraries and hasattr(data, "xyz"):
        return PointCloud(np.asarray(data.xyz))
    return None


def _from_frame(frame: Any) -> PointCloud:
    """Take the columns that name coordinates, or the only three of numbers."""
    columns: dict[str, NDArray[Any]] = {}
    for name in frame.columns:
        values = np.asarray(frame[name].to_numpy())
        if values.dtype.kind == "O":
            try:
                values = values.astype(np.float64)
            except (TypeError, ValueError):
                continue
        if values.dtype.kind in "iufb":
            columns[str(name)] = values
    if len(columns) == 3 and all(name.isdecimal() or name.startswith("column_") for name in columns):
        return PointCloud(np.stack([*columns.values()], axis=1))
    return named_cloud(columns)


def _from_open3d(data: Any) -> PointCloud | None:
    if hasattr(data, "shape") and hasattr(data, "cpu"):
        return _from_array(_from_tensor(data))
    vertices: Any = getattr(data, "vertex", ())
    corners: Any = getattr(data, "triangle", ())
    if "positions" in vertices:
        points = _from_tensor(vertices["positions"])
        faces = _from_tensor(corners["indices"]) if "indices" in corners else np.empty((0, 3))
        return _from_faces(points, faces.astype(np.int64))
    if "positions" in getattr(data, "point", ()):
        names = [name for name in ("positions", "colors", "normals") if name in data.point]
        arrays = {name: _from_tensor(data.point[name]) for name in names}
        return _with_extras(arrays["positions"], arrays.get("colors"), arrays.get("normals"))
    if hasattr(data, "triangles"):
        return _from_faces(data.vertices, np.asarray(data.triangles, np.int64).reshape(-1, 3))
    if hasattr(data, "points") and hasattr(data, "colors"):
        return _with_extras(data.points, data.colors, data.normals)
    return _from_array(np.asarray(data)) if hasattr(data, "__len__") else None  # cloud.points alone


def _from_pyvista(data: Any) -> PointCloud:
    """Take the points, or the surface where there are faces: each the number of its corners, then the corners."""
    flat = np.asarray(getattr(data, "faces", ()), np.int64).reshape(-1)
    polygons, at = [], 0
    while at < len(flat):
        polygons.append(flat[at + 1 : at + 1 + flat[at]])
        at += 1 + int(flat[at])
    return _from_faces(data.points, triangles(polygons))


def _from_faces(vertices: Any, faces: NDArray[np.int64]) -> PointCloud:
    points = float_rows(vertices, "vertices")
    if not len(faces):
        return PointCloud(points)
    content = mesh_or_cloud(PointCloud(points), faces)
    with np.errstate(all="ignore"):  # of vertices that are not finite
        return sample_surface(content) if isinstance(content, Mesh) else content


# sensor_msgs/PointField: the types of numbers by their code
_ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def _from_ros(message: Any) -> PointCloud:
    """Take the fields of a ``sensor_msgs/PointCloud2``, ROS 1 or 2, less its invalid points (NaN)."""
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.datatype in _ROS_TYPES and getattr(field, "count", 1) <= 1]
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + _ROS_TYPES[field.datatype] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    data = message.data if isinstance(message.data, bytes | bytearray | memoryview) else bytes(message.data)
    rows = []
    for row in range(message.height):
        if len(data) < row * message.row_step + message.width * message.point_step:
            raise InputError("PointCloud2: its data are shorter than its width, height and steps say")
        rows.append(np.frombuffer(data, layout, message.width, row * message.row_step))
    if not rows:
        raise InputError("PointCloud2: it holds no points")
    table = np.concatenate(rows)
    return finite(named_cloud(unpack_colors({name: table[name] for name in layout.names or ()})))


def _with_extras(points: Any, colors: Any, normals: Any) -> PointCloud:
    """Take colours that are fractions (Open3D) or have a fourth column (trimesh), and empty arrays for none."""
    colors = None if colors is None or not len(colors) else np.asarray(colors)[:, :3]
    if colors is not None and colors.dtype.kind == "f":
        colors = np.round(colors.clip(0, 1) * 255).astype(np.uint8)
    return PointCloud(np.asarray(points), colors, None if normals is None or not len(normals) else np.asarray(normals))
