"""LAS and LAZ, the formats of airborne and terrestrial laser scans, through the optional package laspy."""

from __future__ import annotations

import io
import struct
import warnings

import numpy as np

from idam.errors import InputError, MissingDependencyError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns
from idam.io.files import check_unpacked_size

__all__ = ["decode"]


def decode(data: bytes) -> PointCloud:
    """Read the points of a LAS or LAZ file, scaled and offset to float64, with their colours if it has them.

    Raises:
        InputError: the file is damaged.
        MissingDependencyError: laspy is not installed, or cannot decompress LAZ.
    """
    try:
        import laspy
    except ImportError as error:
        raise _missing() from error
    if _check_header(data) and not laspy.LazBackend.Lazrs.is_available():
        raise _missing()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # one thread: it does not trust the table of chunks at the end of the file
        reader = laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)
        points = reader.read_points(-1)
    coordinates: dict[str, Numbers] = {axis: np.asarray(points[axis]) for axis in "xyz"}
    colors: dict[str, Numbers] = {}
    if "red" in points.point_format.dimension_names:
        colors = {name: np.asarray(points[name]) for name in ("red", "green", "blue")}
    filled_in = any(values.any() for values in colors.values())
    return cloud_from_columns(coordinates | colors if filled_in else coordinates)


def _missing() -> MissingDependencyError:
    return MissingDependencyError("reading .las and .laz files needs laspy: pip install 'idam[las]'")


def _check_header(data: bytes) -> bool:
    """Refuse counts that the file cannot hold, on which laspy would loop or allocate; tell whether it is compressed."""
    if not data.startswith(b"LASF"):
        raise InputError("not a LAS or LAZ file: check what it is")
    check_size(227, len(data), "a LAS header")
    size, offset, records, point_format, row, points = struct.unpack_from("<HIIBHI", data, 94)
    if data[25] >= 4:  # the minor version
        check_size(375, len(data), "a LAS 1.4 header")
        (points,) = struct.unpack_from("<Q", data, 247)
    check_size(offset, len(data), "points further on")
    check_size(size + 54 * records, offset, f"{records:,} records before the points")
    compressed = bool(point_format & 0xC0)
    if compressed:
        check_unpacked_size(points * row, len(data))
    else:
        check_size(points * row, len(data) - offset, f"{points:,} points")
    return compressed
