"""NumPy's own files, NPY and NPZ, without pickles."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from typing import IO, Any

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns, cloud_from_table, finite_cloud
from idam.io.files import check_unpacked_size

__all__ = ["cloud_from_fields", "decode_npy", "decode_npz", "encode_npy", "encode_npz", "parse_npy"]

_POINT_KEYS = ("points", "xyz", "pcd", "pos")
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the two NumPy writes


def decode_npy(data: bytes) -> PointCloud:
    """Read the points of an array (N, 3 or more); further columns count if they look like colours or normals.

    Of a structured array, fields count by their names.
    """
    array = parse_npy(data)
    return cloud_from_table(_table(array)) if array.dtype.names is None else cloud_from_fields(array)


def cloud_from_fields(array: Numbers) -> PointCloud:
    """Find the cloud in the fields of a structured array, by their names.

    Raises:
        InputError: there are no coordinates, or no finite ones.
    """
    names = [name for name in array.dtype.names or () if array.dtype[name].kind in "iufb"]
    return cloud_from_columns({name: array[name].reshape(-1) for name in names})


def decode_npz(data: bytes) -> PointCloud:
    """Read the points of an archive: its array points, xyz, pcd or pos, or the only one of shape (N, 3).

    Raises:
        InputError: there is no such array, or more than one of that shape.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        key = next((key for key in _POINT_KEYS if key in members), None) or _only_points(archive, members)
        table = _table(_read_member(archive, members[key]))
        extras = {
            name: _table(_read_member(archive, members[name])) for name in ("colors", "normals") if name in members
        }
        if any(len(extra) != len(table) for extra in extras.values()):
            raise InputError("its points, colors and normals differ in number: save it again")
        shapes = _shapes(archive, members)
        attributes = {
            name: _read_member(archive, members[name])
            for name, (shape, kind) in shapes.items()
            if shape == (len(table),) and kind in "iuf"
        }
    if not extras and not attributes:
        return cloud_from_table(table)
    return finite_cloud(table[:, :3], extras.get("colors"), extras.get("normals"), attributes)


def encode_npy(cloud: PointCloud) -> bytes:
    """Encode the points alone, (N, 3) float64."""
    stream = io.BytesIO()
    np.save(stream, cloud.points, allow_pickle=False)
    return stream.getvalue()


def encode_npz(cloud: PointCloud) -> bytes:
    """Encode the arrays points, colors and normals, as far as the cloud has them, and its attributes by their names."""
    arrays: dict[str, Any] = {"points": cloud.points, "colors": cloud.colors, "normals": cloud.normals}
    arrays = {**{name.replace("/", "_"): values for name, values in cloud.attributes.items()}, **arrays}
    stream = io.BytesIO()
    np.savez(stream, **{name: array for name, array in arrays.items() if array is not None})
    return stream.getvalue()


def parse_npy(data: bytes) -> Numbers:
    """Read an array of real numbers; unlike ``numpy.load``, allocate nothing on the header's word alone.

    Raises:
        InputError: it holds something else, or less than its header says.
    """
    stream = io.BytesIO(data)
    shape, fortran_order, dtype = _read_header(stream)
    if (dtype.kind not in "iuf" and dtype.names is None) or min(shape, default=0) < 0 or dtype.hasobject:
        raise InputError(f"holds {dtype} of shape {shape}, expected (N, 3) real numbers: save it as float64")
    count = math.prod(shape)
    check_size(count * dtype.itemsize, len(data) - stream.tell(), f"an array of shape {shape}")
    flat = np.frombuffer(data, dtype, count, stream.tell())
    return flat.reshape(shape, order="F" if fortran_order else "C")


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise InputError(f"is NPY version {version}: save it as a plain float64 array")
    with warnings.catch_warnings():  # of files from Python 2
        warnings.simplefilter("ignore")
        return read(stream)


def _read_member(archive: zipfile.ZipFile, name: str) -> Numbers:
    info = archive.getinfo(name)
    if info.compress_type not in _PACKINGS:
        raise InputError("is packed in a way NumPy does not write: save it with numpy.savez")
    check_unpacked_size(info.file_size, info.compress_size)
    return parse_npy(archive.read(info))


def _shapes(archive: zipfile.ZipFile, members: dict[str, str]) -> dict[str, tuple[tuple[int, ...], str]]:
    """The shape and the kind of number of each array."""
    shapes: dict[str, tuple[tuple[int, ...], str]] = {}
    for key, name in members.items():
        with archive.open(name) as stream:
            shape, _, dtype = _read_header(stream)
            shapes[key] = shape, dtype.kind
    return shapes


def _only_points(archive: zipfile.ZipFile, members: dict[str, str]) -> str:
    shapes = {key: shape for key, (shape, _) in _shapes(archive, members).items()}
    found = [key for key, shape in shapes.items() if len(shape) == 2 and shape[1] == 3]
    if len(found) != 1:
        keys = ", ".join(shapes)[:80] or "none"
        raise InputError(f"holds {len(found)} arrays of shape (N, 3) (its keys: {keys}): name the right one 'points'")
    return found[0]


def _table(array: Numbers) -> Numbers:
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"holds an array of shape {array.shape}, expected (N, 3): save the points as rows")
    return array
