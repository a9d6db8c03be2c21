"""Which file name extension is which format, for reading, writing and moving."""

from __future__ import annotations

import contextlib
import gzip
import logging
import os
import re
import textwrap
import zlib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam.errors import InputError, MissingDependencyError
from idam.io import arrays, e57, kitti, las, mesh, obj, off, pcd, ply, ptx, text
from idam.io.cloud import Mesh, PointCloud, Scan, joined
from idam.io.files import (
    STANDARD,
    StrPath,
    check_destination,
    check_source,
    check_unpacked_size,
    one_line,
    read_bytes,
    write_bytes,
)
from idam.io.transforms import rigid_fault

__all__ = [
    "check_writable",
    "is_readable",
    "move_file",
    "read_content",
    "read_point_cloud",
    "read_scans",
    "write_point_cloud",
]

log = logging.getLogger("idam.io")

Placed = tuple[PointCloud, NDArray[np.float64] | None]
"""A scan of a file of several, and its pose."""
Content = PointCloud | Mesh | list[Placed]

LONGEST = 400
"""Characters of an error's message: a damaged file may quote thousands."""

_TEXT = (".xyz", ".txt", ".asc", ".csv")
_DECODERS: dict[str, Callable[[bytes], Content]] = {
    ".ply": ply.decode,
    ".pcd": pcd.decode,
    ".npy": arrays.decode_npy,
    ".npz": arrays.decode_npz,
    ".obj": obj.decode,
    ".off": off.decode,
    ".stl": mesh.decode_stl,
    ".glb": mesh.decode_glb,
    ".bin": kitti.decode,
    ".pcd.bin": kitti.decode_nuscenes,
    ".ptx": lambda data: [*ptx.decode(data)],
    ".pts": lambda data: [(cloud, None) for cloud in text.decode_pts(data)],
    **dict.fromkeys(_TEXT, text.decode),
}
_READERS: dict[str, Callable[[Path], Content]] = {  # of what may be larger than the memory
    ".e57": lambda path: [*e57.read(path)],
    **dict.fromkeys((".las", ".laz"), las.read),
}
_ENCODERS: dict[str, Callable[[PointCloud], bytes]] = {
    ".ply": ply.encode,
    ".pcd": pcd.encode,
    ".npy": arrays.encode_npy,
    ".npz": arrays.encode_npz,
    ".csv": text.encode_csv,
    ".pts": text.encode_pts,
    ".obj": obj.encode,
    ".off": off.encode,
    ".bin": kitti.encode,
    ".las": partial(las.encode, compress=False),
    ".laz": partial(las.encode, compress=True),
    ".e57": e57.encode,
    **dict.fromkeys((".xyz", ".txt", ".asc"), text.encode_xyz),
}
_MESH_ENCODERS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": ply.encode,
    ".obj": obj.encode,
    ".off": off.encode,
    ".stl": mesh.encode_stl,
    ".glb": mesh.encode_glb,
}
_MOVERS: dict[str, Callable[[bytes, NDArray[np.float64]], bytes]] = {  # which keep what idam does not read
    ".ply": ply.move,
    ".obj": obj.move,
    ".off": off.move,
}
_OF_SEVERAL_SCANS = (".e57", ".ptx", ".pts")
_SCAN_NUMBER = re.compile(r"(.+)#(\d+)")


def read_point_cloud(path: StrPath) -> PointCloud:
    """Read a point cloud or a mesh; ``docs/formats.md`` says what of each format.

    Coordinates are float64 as far as the file holds them. Points with a NaN or infinite coordinate are left out. A mesh
    (a file with faces) becomes 20,000 points spread evenly over its surface, always the same ones, with the normals of
    their faces. The scans of a file of several become one cloud, each in its pose; ``site.e57#2`` is the second alone.
    ``-`` is text from the standard input.

    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no points.
        MissingDependencyError: it needs a package that is not installed.
    """
    content = read_content(path)
    if isinstance(content, Mesh):
        return _sampled(path, content)
    return joined([scan.placed() for scan in content])


def read_scans(path: StrPath) -> list[Scan]:
    """Read the scans of a file: all of an E57, PTX or PTS file, each in its own frame with its pose; else the one.

    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no points.
        MissingDependencyError: it needs a package that is not installed.
    """
    content = read_content(path)
    return [Scan(Path(path).name, _sampled(path, content))] if isinstance(content, Mesh) else content


def read_content(path: StrPath) -> Mesh | list[Scan]:
    """Read a file as it is: a mesh, or its scans.

    Raises:
        InputError: the file is missing, damaged, of an unknown format, or holds no points.
        MissingDependencyError: it needs a package that is not installed.
    """
    content = _read(path)
    if isinstance(content, list):
        return _scans(path, content)
    return content if isinstance(content, Mesh) else [Scan(Path(path).name, content)]


def write_point_cloud(path: StrPath, cloud: Any) -> None:
    """Write a point cloud, atomically, with all that the format can hold of it; ``docs/formats.md`` says what.

    PLY and PCD are binary, with float32 coordinates. Where that would round them by more than a millionth of the
    cloud's extent, far from the origin, PLY has float64 ones, and PCD is ASCII. Text holds every digit. ``-`` is text
    to the standard output.

    Args:
        path: where to; the extension is the format.
        cloud: a :class:`PointCloud`, or what :func:`as_point_cloud` makes one of.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
        MissingDependencyError: it needs a package that is not installed.
    """
    from idam.io.convert import as_point_cloud

    _write(path, as_point_cloud(cloud))


def move_file(source: StrPath, transformation: ArrayLike, output: StrPath) -> None:
    """Write a file moved by a rigid transform (4, 4), with all that the output's format can hold of it.

    A mesh stays a mesh. From PLY to PLY, OBJ to OBJ, OFF to OFF, and between LAS and LAZ, of any size, all the rest of
    the file stays as it is; but a LAS file's coordinate system, which no longer holds, is left out with a warning.

    Raises:
        InputError: the source cannot be read, or the output not be written.
        MissingDependencyError: a package is needed that is not installed.
    """
    matrix = np.asarray(transformation, np.float64)
    path, kind = _resolve(source)[0], _suffix(output)
    if {_suffix(path), kind} <= {".las", ".laz"}:
        with _faults_of(source, kind):
            las.move(check_source(path), matrix, output)
        return
    if _suffix(path) == kind and kind in _MOVERS and os.fspath(path) != STANDARD:
        data = read_bytes(path)
        with _faults_of(source, kind):
            moved = _MOVERS[kind](data, matrix)
        write_bytes(output, moved)
        return
    content = _read(source)
    if isinstance(content, list):
        scans = _scans(source, content)
        if kind == ".e57":
            _write_scans(output, [Scan(scan.name, scan.cloud, matrix @ _pose(scan)) for scan in scans])
            return
        content = joined([scan.placed() for scan in scans])
    with np.errstate(all="ignore"):  # of damaged normals
        moved_content = content.transformed(matrix)
    _write(output, moved_content)


def check_writable(path: StrPath) -> None:
    """Find out before a long computation whether :func:`write_point_cloud` can write to ``path``.

    Raises:
        InputError: it cannot.
        MissingDependencyError: it needs a package that is not installed.
    """
    suffix = _suffix(path)
    if suffix not in _ENCODERS and suffix not in _MESH_ENCODERS:
        raise _unknown(path, "write", {**_ENCODERS, **_MESH_ENCODERS})
    if suffix in (".las", ".laz"):
        las.check_installed(suffix == ".laz")
    if suffix == ".e57":
        e57.check_installed()
    check_destination(path)


def is_readable(path: StrPath) -> bool:
    """Whether a file has the extension of a format that can be read."""
    return _suffix(path) in _DECODERS | _READERS


def _read(path: StrPath) -> Content:
    file, number = _resolve(path)
    suffix, packed = _suffix(file), _is_packed(file)
    if suffix not in _DECODERS and suffix not in _READERS and not os.path.isdir(file):  # noqa: PTH112, raises less
        raise _unknown(file, "read", {**_DECODERS, **_READERS})
    if suffix in _READERS and not packed:
        source = check_source(file)
        with _faults_of(path, suffix):
            content = _READERS[suffix](source)
    else:
        data = read_bytes(file)
        with _faults_of(path, suffix):
            if suffix in _READERS:
                raise InputError("is packed twice: unpack it with gunzip first")
            content = _DECODERS[suffix](_unpacked(data) if packed else data)
    if isinstance(content, list):
        for place, (_, pose) in enumerate(content, start=1):
            fault = "" if pose is None else rigid_fault(pose)
            if fault:
                raise InputError(f"{path}: the pose of scan {place} is not a rigid transform: {fault}")
    if number is None:
        return content
    if not isinstance(content, list) or not 1 <= number <= len(content):
        scans = len(content) if isinstance(content, list) else 1
        raise InputError(f"{path}: {file} has no scan {number}: it holds {scans}, counted from 1")
    return [content[number - 1]]


def _sampled(path: StrPath, content: Mesh) -> PointCloud:
    with _faults_of(path, _suffix(path)):
        return mesh.sample_surface(content)


def _scans(path: StrPath, content: list[Placed]) -> list[Scan]:
    name = Path(path).name
    if len(content) == 1:
        return [Scan(name, *content[0])]
    return [Scan(f"{name}#{number}", cloud, pose) for number, (cloud, pose) in enumerate(content, start=1)]


def _pose(scan: Scan) -> NDArray[np.float64]:
    return np.eye(4) if scan.pose is None else scan.pose


def _write(path: StrPath, content: PointCloud | Mesh) -> None:
    check_writable(path)
    suffix = _suffix(path)
    if isinstance(content, Mesh) and suffix not in _MESH_ENCODERS:
        log.warning("%s holds no faces: it gets %s points of the mesh's surface", path, f"{mesh.SAMPLES:,}")
        content = _sampled(path, content)
    elif isinstance(content, PointCloud) and suffix not in _ENCODERS:
        raise InputError(f"{path}: a {suffix} file holds a mesh, not points: write .ply instead")
    encode: Any = (_MESH_ENCODERS if isinstance(content, Mesh) else _ENCODERS)[suffix]
    _write_bytes_of(path, partial(encode, content))


def _write_scans(path: StrPath, scans: list[Scan]) -> None:
    check_writable(path)
    _write_bytes_of(path, lambda: e57.encode_scans([(scan.cloud, _pose(scan)) for scan in scans]))


def _write_bytes_of(path: StrPath, encode: Callable[[], bytes]) -> None:
    try:
        with np.errstate(all="ignore"):
            data = encode()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    write_bytes(path, gzip.compress(data, mtime=0) if _is_packed(path) else data)


def _resolve(path: StrPath) -> tuple[StrPath, int | None]:
    """The file, and which scan of it is meant: ``site.e57#2`` is the second, unless a file has that name."""
    match = _SCAN_NUMBER.fullmatch(os.fspath(path))
    if match and _suffix(match[1]) in _OF_SEVERAL_SCANS and not os.path.lexists(path):
        return match[1], int(match[2])
    return path, None


def _suffix(path: StrPath) -> str:
    """What tells the format: the extension in small letters, without .gz."""
    if os.fspath(path) == STANDARD:
        return ".xyz"
    name = Path(path).name.lower().removesuffix(".gz")
    return ".pcd.bin" if name.endswith(".pcd.bin") else Path(name).suffix


def _is_packed(path: StrPath) -> bool:
    return os.fspath(path).lower().endswith(".gz")


def _unpacked(data: bytes) -> bytes:
    """What gzip packed, in one piece or several."""
    most, parts = 2**28 + 100 * len(data), []
    packed = len(data)
    while data:
        stream = zlib.decompressobj(wbits=31)
        parts.append(stream.decompress(data, most + 1))
        check_unpacked_size(sum(map(len, parts)), packed)
        if not stream.eof:
            raise InputError("cut short: its packed data have no end: copy or export it again")
        data = stream.unused_data
    if not any(parts):
        raise InputError("is empty once unpacked: copy or export it again")
    return b"".join(parts)


@contextlib.contextmanager
def _faults_of(path: StrPath, suffix: str) -> Iterator[None]:
    """Whatever is wrong with a file becomes one line that names it."""
    try:
        with np.errstate(all="ignore"):  # of damaged numbers
            yield
    except InputError as error:
        message = "".join(letter if letter.isprintable() else "?" for letter in str(error))
        message = message if len(message) <= LONGEST else textwrap.shorten(message, LONGEST)
        raise error if message.startswith(f"{path}: ") else InputError(f"{path}: {message}") from error
    except MissingDependencyError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: thin it out first") from error
    except Exception as error:  # there is no telling what parsers throw at a damaged file
        raise InputError(f"{path}: damaged, or not {suffix} ({one_line(error)}): export it again") from error


def _unknown(path: StrPath, verb: str, known: Iterable[str]) -> InputError:
    return InputError(
        f"{path}: unknown point cloud format '{Path(path).suffix}': the ones to {verb} are {', '.join(sorted(known))}"
    )
