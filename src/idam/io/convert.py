"""Whatever a caller has in hand, as a point cloud."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud, float_rows
from idam.io.formats import read_point_cloud
from idam.io.mesh import sample_surface

__all__ = ["as_point_cloud"]


def as_point_cloud(data: Any) -> PointCloud:
    """Make a point cloud of a path, an array or another library's object; NaN in arrays stay.

    Args:
        data: a path; a :class:`PointCloud`; an (N, 3) array, nested list or PyTorch tensor on any device; an Open3D
            point cloud, legacy or tensor; a trimesh point cloud, or mesh, which is sampled as a mesh file is.

    Raises:
        InputError: the file cannot be read, or the object holds no (N, 3) real numbers.
    """
    if isinstance(data, PointCloud):
        return data
    if isinstance(data, str | os.PathLike):
        return read_point_cloud(data)
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(data, torch.Tensor):
        return PointCloud(_from_tensor(data))
    if hasattr(data, "__array__") or isinstance(data, list | tuple):
        return PointCloud(data)
    return _from_library(data)


def _from_tensor(tensor: Any) -> Any:
    """Turn a PyTorch or Open3D tensor into an array."""
    try:
        if hasattr(tensor, "detach"):
            tensor = tensor.detach()
            tensor = tensor.double() if tensor.is_floating_point() else tensor  # NumPy has no bfloat16
        return tensor.cpu().numpy()
    except (RuntimeError, TypeError, NotImplementedError) as error:
        raise InputError("tensor: expected (N, 3) dense real numbers: convert it to a NumPy array first") from error


def _from_library(data: Any) -> PointCloud:
    libraries = {base.__module__.partition(".")[0] for base in type(data).__mro__}
    if "open3d" in libraries and "positions" in getattr(data, "point", ()):
        names = [name for name in ("positions", "colors", "normals") if name in data.point]
        arrays = {name: _from_tensor(data.point[name]) for name in names}
        return _with_extras(arrays["positions"], arrays.get("colors"), arrays.get("normals"))
    if "open3d" in libraries and hasattr(data, "points"):
        return _with_extras(data.points, data.colors, data.normals)
    if "trimesh" in libraries and hasattr(data, "faces"):
        with np.errstate(all="ignore"):  # of vertices that are not finite
            return sample_surface(float_rows(data.vertices, "vertices"), np.asarray(data.faces, np.int64))
    if "trimesh" in libraries and hasattr(data, "vertices"):
        return _with_extras(data.vertices, getattr(data, "colors", None), None)
    raise InputError(
        f"cannot find points in a {type(data).__name__}: expected (N, 3): pass a path, an array, a tensor, "
        "or an Open3D or trimesh point cloud"
    )


def _with_extras(points: Any, colors: Any, normals: Any) -> PointCloud:
    """Take colours that are fractions (Open3D) or have a fourth column (trimesh), and empty arrays for none."""
    colors = None if colors is None or not len(colors) else np.asarray(colors)[:, :3]
    if colors is not None and colors.dtype.kind == "f":
        colors = np.round(colors.clip(0, 1) * 255).astype(np.uint8)
    return PointCloud(np.asarray(points), colors, None if normals is None or not len(normals) else np.asarray(normals))
