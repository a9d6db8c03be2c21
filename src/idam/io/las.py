"""LAS and LAZ, the formats of airborne and terrestrial laser scans, through the optional package laspy.

Neither laspy nor lazrs, which decompresses LAZ for it, doubts the counts and lengths in a file: a wrong one makes them
loop, or allocate until the process is aborted. So all that they would trust is checked here first.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import mmap
import struct
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from idam import rigid
from idam.errors import InputError, MissingDependencyError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns
from idam.io.copc import coarse_points, is_copc
from idam.io.files import StrPath, check_unpacked_size, one_line, replacing, silenced
from idam.io.names import normal_names

__all__ = ["COPC_POINTS", "MOST_POINTS", "check_installed", "encode", "move", "read"]

log = logging.getLogger("idam.io")

MOST_POINTS = 10_000_000
"""Points past which a file is thinned while it is read, to every second, third and so on: registration sees 10^4 to
10^6 of them, and memory stays bounded (measured in docs/formats.md)."""
COPC_POINTS = 2_000_000
"""Points up to which levels of a COPC file are read: they lie evenly, so fewer do, and only they are unpacked."""

_OWN = "_"  # behind the name of an extra dimension where LAS has one of that name, of other numbers
_CHUNK = 1_000_000
_COLORS = ("red", "green", "blue")
_COORDINATES = ("X", "Y", "Z")
_CRS = ("LASF_Projection", "liblas")  # who writes a coordinate system, as GeoTIFF keys or WKT
_TURNED = ("x_t", "y_t", "z_t")  # the direction of a waveform

# Layers of bytes that an item of a point (by its type) is split into in LAZ 1.4; other items have one for each byte.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}


def read(path: Path) -> PointCloud:
    """Read the points of a LAS or LAZ file, scaled and offset to float64, with their colours if it has them.

    What all points have as 0 is left out. Of more than :data:`MOST_POINTS`, every second, third and so on is read; of a
    COPC file with more than :data:`COPC_POINTS`, the first levels of its octree.

    Raises:
        InputError: the file is damaged.
        MissingDependencyError: laspy is not installed, or cannot decompress LAZ.
    """
    check_installed(compressed=False)
    with _opened(path) as reader:
        count = reader.header.point_count
        step = max(1, math.ceil(count / MOST_POINTS))
        if count > COPC_POINTS and is_copc(reader.header):
            points, depth = coarse_points(path, COPC_POINTS)
            log.warning(
                "%s: reading %s of its %s points, %d levels of its octree",
                path,
                f"{len(points):,}",
                f"{count:,}",
                depth,
            )
            every = [_columns(points)]
        elif step > 1:
            log.warning("%s: reading every %d. of its %s points", path, step, f"{count:,}")
            every = _every(reader, step)
        else:
            every = [_columns(reader.read_points(-1))]
        columns = {name: np.concatenate([part[name] for part in every]) for name in every[0]} if every else {}
    zero = [name for name, values in columns.items() if name not in "xyz" and not values.any()]
    if set(_COLORS) & set(zero) != set(_COLORS):
        zero = [name for name in zero if name not in _COLORS]
    kept = {name: values for name, values in columns.items() if name not in zero}
    own = {name: name.removesuffix(_OWN) for name in kept}  # what encode() could not put into LAS's own dimension
    return cloud_from_columns({own[name] if own[name] in zero else name: values for name, values in kept.items()})


def encode(cloud: PointCloud, compress: bool) -> bytes:
    """Encode LAS 1.4, with coordinates in steps of some 2^-31 of the extent.

    What has no place of its own in the format becomes extra bytes.

    Raises:
        MissingDependencyError: laspy is not installed, or cannot compress.
    """
    check_installed(compress)
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6 if cloud.colors is None else 7)
    lowest, highest = cloud.points.min(axis=0), cloud.points.max(axis=0)
    header.offsets = np.round((lowest + highest) / 2)
    header.scales = np.full(3, _finest_scale(float((highest - lowest).max()), 0.0))
    columns: dict[str, Numbers] = dict(cloud.attributes)
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    known = set(header.point_format.dimension_names) - set(_COORDINATES)
    extra = {name: values for name, values in columns.items() if name not in known or not _fits(header, name, values)}
    for name, values in extra.items():
        kind = values.dtype if values.dtype.kind in "iuf" and values.dtype.itemsize <= 8 else np.dtype("f8")
        kind = np.dtype("f4") if kind == np.float16 else kind
        header.add_extra_dim(laspy.ExtraBytesParams(_extra_name(name, known), kind))
    data = laspy.LasData(header)
    data.x, data.y, data.z = cloud.points.T
    if cloud.colors is not None:
        data.red, data.green, data.blue = cloud.colors.T.astype(np.uint16) * 257
    for name, values in columns.items():
        data[_extra_name(name, known) if name in extra else name] = values
    stream = io.BytesIO()
    data.write(stream, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs if compress else None)
    return stream.getvalue()


def move(source: Path, transformation: rigid.Array, output: StrPath) -> None:
    """Write a file moved by a rigid transform (4, 4), chunk by chunk: every attribute stays.

    Scale and offset are chosen anew, ten times finer than the source's, as far as its numbers of 32 bits reach. Its
    coordinate system is left out, with a warning, unless the transform is the identity.

    Raises:
        InputError: the file is damaged, or the output cannot be written.
        MissingDependencyError: laspy is not installed, or cannot compress.
    """
    import laspy

    compress = str(output).lower().endswith(".laz")
    check_installed(compress)
    with _opened(source) as reader, replacing(output) as temporary:
        header = _moved_header(reader.header, transformation)
        backend = laspy.LazBackend.Lazrs if compress else None
        with (
            temporary.open("wb") as stream,
            laspy.LasWriter(stream, header, do_compress=compress, laz_backend=backend, closefd=False) as writer,
        ):
            for points in reader.chunk_iterator(_CHUNK):
                _move_points(points, header, transformation)
                writer.write_points(points)


def check_installed(compressed: bool) -> None:
    """Raise MissingDependencyError unless laspy is there, and lazrs where it is needed."""
    try:
        import laspy
    except ImportError as error:
        raise _missing() from error
    if compressed and not laspy.LazBackend.Lazrs.is_available():
        raise _missing()


def _missing() -> MissingDependencyError:
    return MissingDependencyError(".las and .laz files need laspy: pip install 'idam[las]'")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of the file, once all that it would trust has been checked."""
    import laspy

    with path.open("rb") as stream:
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        check_installed(_check_header(data))
        try:
            with silenced("laspy"):
                reader = laspy.LasReader(stream, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False)
                header = reader.header
                if header.are_points_compressed:
                    description = header.vlrs.get("LasZipVlr")[0].record_data
                    _check_chunks(data, header.offset_to_point_data, header.point_format.size, description)
                yield reader
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # of lazrs, which is written in Rust; it is no Exception
                raise
            raise InputError(f"damaged ({one_line(error)}): copy or export it again") from error


def _every(reader: Any, step: int) -> list[dict[str, Numbers]]:
    """Every step-th point, read chunk by chunk."""
    parts, at = [], 0
    for points in reader.chunk_iterator(_CHUNK):
        parts.append(_columns(points[-at % step :: step]))
        at += len(points)
    return parts


def _columns(points: Any) -> dict[str, Numbers]:
    columns: dict[str, Numbers] = {axis: np.array(points[axis]) for axis in "xyz"}
    for name in points.point_format.dimension_names:
        if name in _COORDINATES:
            continue
        values = np.array(points[name])
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{place}": values[:, place] for place in range(values.shape[1])}
    return columns


def _moved_header(header: Any, transformation: rigid.Array) -> Any:
    moved = deepcopy(header)
    for place in reversed(range(len(moved.vlrs))):  # of COPC, whose order of points ends here
        if moved.vlrs[place].user_id == "copc":
            moved.vlrs.pop(place)
    if np.array_equal(transformation, np.eye(4)):
        return moved
    dropped = [place for place in range(len(moved.vlrs)) if moved.vlrs[place].user_id in _CRS]
    if dropped:
        log.warning("the coordinate system of the source is left out: the moved points are no longer in it")
    for place in reversed(dropped):
        moved.vlrs.pop(place)
    corners = np.array(np.meshgrid(*zip(header.mins, header.maxs, strict=True))).reshape(3, -1).T
    corners = rigid.apply(transformation, corners)
    moved.offsets = np.round(corners.mean(axis=0))
    extent = float(2 * np.abs(corners - moved.offsets).max())
    moved.scales = np.full(3, _finest_scale(extent, float(np.min(header.scales)) / 10))
    return moved


def _move_points(points: Any, header: Any, transformation: rigid.Array) -> None:
    """Move a chunk of points, and turn its directions, in place."""
    moved = rigid.apply(transformation, np.stack([points.x, points.y, points.z], axis=1))
    steps = np.round((moved - header.offsets) / header.scales)
    if np.abs(steps).max(initial=0) >= 2**31:
        raise InputError("its header understates how far its points reach: export it again")
    points.offsets, points.scales = header.offsets, header.scales
    for name, values in zip(_COORDINATES, steps.T.astype(np.int32), strict=True):
        points[name] = values
    names = list(points.point_format.dimension_names)
    for directions in (_TURNED if set(_TURNED) <= set(names) else None, normal_names(names)):
        if directions is not None:
            turned = np.stack([np.asarray(points[name]) for name in directions], axis=1) @ transformation[:3, :3].T
            for name, values in zip(directions, turned.T, strict=True):
                points[name] = values


def _finest_scale(extent: float, wanted: float) -> float:
    """The wanted step of coordinates, or the finest power of ten that 32 bits allow over such an extent."""
    least = 10.0 ** math.ceil(math.log10(max(extent, 1e-12) / 2**31))
    return max(wanted, least)


def _fits(header: Any, name: str, values: Numbers) -> bool:
    """Whether a dimension of LAS's own can hold the values as they are."""
    dimension = header.point_format.dimension_by_name(name)
    if dimension.kind.name == "FloatingPoint":
        return True
    whole = np.isfinite(values).all() and (values == np.round(values)).all()
    low, high = float(np.min(values, initial=0)), float(np.max(values, initial=0))
    return bool(whole and dimension.min <= low and high <= dimension.max)


def _extra_name(name: str, known: set[str]) -> str:
    """A name of up to 32 bytes that no dimension of LAS's own has."""
    short = name.encode("ascii", "replace").decode()[:30] or "unnamed"
    return short + _OWN if short in known else short


def _check_header(data: Any) -> bool:
    """Refuse counts that the file cannot hold; tell whether its points are compressed."""
    if data[:4] != b"LASF":
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


def _check_chunks(data: Any, offset: int, row: int, description: bytes) -> None:
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


def _check_layers(data: Any, at: int, end: int, row: int, layers: int) -> None:
    """Refuse layers longer than the file: a chunk is a point, the number of points, the layers' lengths, the layers."""
    while at < end:
        lengths = np.frombuffer(data, "<u4", layers, at + row + 4)
        at += row + 4 + lengths.nbytes + int(lengths.sum(dtype=np.int64))
        check_size(at, len(data), "a compressed chunk")
