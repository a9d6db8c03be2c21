"""Which file name extension is which format, for reading and for writing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError, MissingDependencyError
from idam.io import arrays, las, mesh, pcd, ply, text
from idam.io.cloud import PointCloud
from idam.io.files import StrPath, check_destination, one_line, read_bytes, write_bytes

__all__ = ["check_writable", "read_point_cloud", "write_point_cloud"]

_DECODERS: dict[str, Callable[[bytes], PointCloud]] = {
    ".ply": ply.decode,
    ".pcd": pcd.decode,
    ".npy": arrays.decode_npy,
    ".npz": arrays.decode_npz,
    ".obj": mesh.decode_obj,
    ".off": mesh.decode_off,
    ".stl": mesh.decode_stl,
    **dict.fromkeys((".las", ".laz"), las.decode),
    **dict.fromkeys((".xyz", ".txt", ".asc", ".csv", ".pts"), text.decode),
}
_ENCODERS: dict[str, Callable[[PointCloud], bytes]] = {
    ".ply": lambda cloud: ply.encode(cloud, _coordinate_type(cloud)),
    ".pcd": lambda cloud: pcd.encode(cloud, _coordinate_type(cloud)),
    ".npy": arrays.encode_npy,
    ".npz": arrays.encode_npz,
    ".csv": text.encode_csv,
    ".pts": text.encode_pts,
    **dict.fromkeys((".xyz", ".txt", ".asc"), text.encode_xyz),
}


def read_point_cloud(path: StrPath) -> PointCloud:
    """Read a point cloud: PLY, PCD, XYZ, TXT, ASC, CSV, PTS, NPY, NPZ, LAS or LAZ; or a mesh: PLY, OBJ, STL or OFF.

    Coordinates are float64 as far as the file holds them. Points with a NaN or infinite coordinate are left out. A mesh
    (a file with faces) becomes 20,000 points spread evenly over its surface, always the same ones, with the normals of
    their faces.

    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no points.
        MissingDependencyError: it is LAS or LAZ, and laspy is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _DECODERS and not os.path.isdir(path):  # noqa: PTH112, which would raise where it may not look
        raise _unknown(path, "read", _DECODERS)
    data = read_bytes(path)
    try:
        with np.errstate(all="ignore"):  # of damaged numbers
            return _DECODERS[suffix](data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except MissingDependencyError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: thin it out first") from error
    except Exception as error:  # there is no telling what parsers throw at a damaged file
        raise InputError(f"{path}: damaged, or not {suffix} ({one_line(error)}): export it again") from error


def write_point_cloud(path: StrPath, cloud: Any) -> None:
    """Write a point cloud, atomically: PLY, PCD, XYZ, TXT, ASC, CSV, PTS, NPY or NPZ.

    PLY and PCD are binary, with float32 coordinates. Where that would round them by more than a millionth of the
    cloud's extent, far from the origin, PLY has float64 ones, and PCD is ASCII. Text holds every digit. PTS has no
    normals, NPY points alone.

    Args:
        path: where to; the extension is the format.
        cloud: a :class:`PointCloud`, or what :func:`as_point_cloud` makes one of.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
    """
    from idam.io.convert import as_point_cloud

    encode = _encoder(path)
    cloud = as_point_cloud(cloud)
    with np.errstate(all="ignore"):
        data = encode(cloud)
    write_bytes(path, data)


def check_writable(path: StrPath) -> None:
    """Find out before a long computation whether :func:`write_point_cloud` can write to ``path``.

    Raises:
        InputError: it cannot.
    """
    _encoder(path)
    check_destination(path)


def _encoder(path: StrPath) -> Callable[[PointCloud], bytes]:
    encode = _ENCODERS.get(Path(path).suffix.lower())
    if encode is None:
        raise _unknown(path, "write", _ENCODERS)
    return encode


def _unknown(path: StrPath, verb: str, known: Iterable[str]) -> InputError:
    return InputError(
        f"{path}: unknown point cloud format '{Path(path).suffix}': the ones to {verb} are {', '.join(sorted(known))}"
    )


def _coordinate_type(cloud: PointCloud) -> str:
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    rounding = np.abs(points - points.astype(np.float32)).max(initial=0)
    extent = np.ptp(points, axis=0).max(initial=0) if len(points) else 0.0
    return "f8" if rounding > 1e-6 * extent else "f4"
