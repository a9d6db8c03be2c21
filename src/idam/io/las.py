"""LAS and LAZ, the formats of airborne and terrestrial laser scans, through the optional package laspy.

Neither laspy nor lazrs, which decompresses LAZ for it, doubts the counts and lengths in a file: a wrong one makes them
loop, or allocate until the process is aborted. So all that they would trust is checked here first.
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np

from idam.errors import InputError, MissingDependencyError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns
from idam.io.files import check_unpacked_size, one_line, silenced

__all__ = ["decode"]

_COLORS = ("red", "green", "blue")

# Layers of bytes that an item of a point (by its type) is split into in LAZ 1.4; other items have one for each byte.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}


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

    points = _read_points(data)
    coordinates: dict[str, Numbers] = {axis: np.asarray(points[axis]) for axis in "xyz"}
    colors: dict[str, Numbers] = {}
    if "red" in points.point_format.dimension_names:
        colors = {name: np.asarray(points[name]) for name in _COLORS}
    filled_in = any(values.any() for values in colors.values())
    return cloud_from_columns(coordinates | colors if filled_in else coordinates)


def _missing() -> MissingDependencyError:
    return MissingDependencyError("reading .las and .laz files needs laspy: pip install 'idam[las]'")


def _read_points(data: bytes) -> Any:
    import laspy

    try:
        with silenced("laspy"):
            reader = laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)
            header = reader.header
            if header.are_points_compressed:
                description = header.vlrs.get("LasZipVlr")[0].record_data
                _check_chunks(data, header.offset_to_point_data, header.point_format.size, description)
            return reader.read_points(-1)
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # of lazrs, which is written in Rust; it is no Exception
            raise
        raise InputError(f"damaged ({one_line(error)}): copy or export it again") from error


def _check_header(data: bytes) -> bool:
    """Refuse counts that the file cannot hold; tell whether its points are compressed."""
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


def _check_chunks(data: bytes, offset: int, row: int, description: bytes) -> None:
    """Refuse compressed points described wrongly, and more or longer chunks of them than the file can hold."""
    check_size(offset + 8, len(data), "compressed points")
    (table,) = struct.unpack_from("<q", data, offset)
    if table == -1:  # not known when the points were written: it is at the end
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not offset <= table <= len(data) - 8:
        raise InputError("cut short: its table of compressed chunks is missing: copy or export it again")
    _, chunks = struct.unpack_from("<II", data, table)
    check_size(chunks, len(data), f"{chunks:,} compressed chunks")

    compressor, chunk_size, items = struct.unpack_from("<H10xI16xH", description)
    kinds = np.frombuffer(description, "<u2", 3 * items, 34).reshape(items, 3).tolist()
    if chunk_size == 0 or sum(size for _, size, _ in kinds) != row:
        raise InputError("damaged: it describes its compressed points wrongly: copy or export it again")
    if compressor == 3:
        _check_layers(data, offset + 8, table, row, sum(_LAYERS.get(kind, size) for kind, size, _ in kinds))


def _check_layers(data: bytes, at: int, end: int, row: int, layers: int) -> None:
    """Refuse layers longer than the file: a chunk is a point, the number of points, the layers' lengths, the layers."""
    while at < end:
        lengths = np.frombuffer(data, "<u4", layers, at + row + 4)
        at += row + 4 + lengths.nbytes + int(lengths.sum(dtype=np.int64))
        check_size(at, len(data), "a compressed chunk")
