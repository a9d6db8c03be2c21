"""PLY, the Stanford polygon format: ASCII, and binary of both byte orders."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import check_size, cloud_from_columns, parse_numbers, positions
from idam.io.mesh import fan, sample_surface, triangles

__all__ = ["decode", "encode"]

_C_NAMES = {
    "char": "int8",
    "uchar": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "int": "int32",
    "uint": "uint32",
    "float": "float32",
    "double": "float64",
}
_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r|$)")

Column = NDArray[Any] | list[NDArray[Any]]  # a list: of lists that differ in length, one array a row


@dataclass(frozen=True)
class _Property:
    name: str
    type: np.dtype[Any]
    is_integer: bool
    count_type: np.dtype[Any] | None  # of a list's length; None: not a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def decode(data: bytes) -> PointCloud:
    """Read the points of a PLY file; if it has faces, sample points on their surface.

    Raises:
        InputError: the file is damaged, or has no vertices.
    """
    elements, is_ascii, offset = _parse_header(data)
    if is_ascii:  # one decoder for both: text becomes a binary file in which every type is a double
        data, offset = parse_numbers(data[offset:]).tobytes(), 0
    columns: dict[str, dict[str, Column]] = {}
    for element in elements:
        columns[element.name], offset = _read_element(data, offset, element, "numbers" if is_ascii else "bytes")
    if is_ascii and offset != len(data):
        raise InputError("damaged: it holds more numbers than its header says: export it again")

    vertex = {name: column for name, column in columns.get("vertex", {}).items() if isinstance(column, np.ndarray)}
    faces = _faces(columns.get("face", {}))
    return sample_surface(positions(vertex), faces) if len(faces) else cloud_from_columns(vertex)


def encode(cloud: PointCloud, coordinates: str) -> bytes:
    """Encode a binary little endian PLY file with coordinates of type ``f4`` or ``f8``."""
    names = {"f4": "float", "f8": "double", "u1": "uchar"}
    fields = [(name, coordinates) for name in ("x", "y", "z")]
    columns = [*cloud.points.T]
    if cloud.normals is not None:
        fields += [(name, "f4") for name in ("nx", "ny", "nz")]
        columns += [*cloud.normals.T]
    if cloud.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns += [*cloud.colors.T]
    rows = np.empty(len(cloud.points), [(name, f"<{code}") for name, code in fields])
    for (name, _), values in zip(fields, columns, strict=True):
        rows[name] = values
    properties = "".join(f"property {names[code]} {name}\n" for name, code in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return header.encode() + rows.tobytes()


def _parse_header(data: bytes) -> tuple[list[_Element], bool, int]:
    """Find the elements, whether they are written as text, and where they start."""
    end = _END_OF_HEADER.search(data)
    if not data.startswith((b"ply\n", b"ply\r", b"ply ")) or end is None:
        raise InputError("not a PLY file (no 'ply' ... 'end_header'): check what it is")
    order = None
    elements: list[_Element] = []
    for line in re.split("[\r\n]+", data[: end.start()].decode("latin-1"))[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as name, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", count_type, kind, name] if elements and order is not None:
                elements[-1].properties.append(_property(name, order, kind, count_type))
            case ["property", kind, name] if elements and order is not None:
                elements[-1].properties.append(_property(name, order, kind))
            case _:
                raise InputError(f"damaged: its header has the line '{line.strip()[:60]}': export it again")
    if order is None:
        raise InputError("damaged: its header has no 'format' line: export it again")
    return elements, order == "", end.end()


def _property(name: str, order: str, kind: str, count_type: str | None = None) -> _Property:
    counts = _type(count_type, order) if count_type else None
    return _Property(name, _type(kind, order), "int" in _C_NAMES.get(kind, kind), counts)


def _type(name: str, order: str) -> np.dtype[Any]:
    name = _C_NAMES.get(name, name)
    if name not in _C_NAMES.values():
        raise InputError(f"damaged: its header has the unknown type '{name[:60]}': export it again")
    return np.dtype(order + np.dtype(name).str[1:] if order else "<f8")


def _read_element(data: bytes, offset: int, element: _Element, unit: str) -> tuple[dict[str, Column], int]:
    """Read the element's columns, and find where the next one starts."""
    size = 8 if unit == "numbers" else 1
    least = element.count * sum((each.count_type or each.type).itemsize for each in element.properties)
    check_size(least // size, (len(data) - offset) // size, f"{element.count:,} rows of '{element.name}'", unit)
    if least == 0:
        return {each.name: np.empty(0 if each.count_type is None else (0, 0)) for each in element.properties}, offset

    layout = _layout_of_first_row(data, offset, element)
    if element.count * layout.itemsize <= len(data) - offset:
        rows = np.frombuffer(data, layout, element.count, offset)
        lengths = [rows[name] for name in layout.names or () if name.startswith("length")]
        if all((each == each[0]).all() for each in lengths):
            columns = [rows[f"values{index}"] for index in range(len(element.properties))]
            return _named(columns, element), offset + rows.nbytes
    return _read_rows(data, offset, element)


def _layout_of_first_row(data: bytes, offset: int, element: _Element) -> np.dtype[Any]:
    fields: list[tuple[str, np.dtype[Any]] | tuple[str, np.dtype[Any], tuple[int]]] = []
    for index, each in enumerate(element.properties):
        if each.count_type is None:
            fields.append((f"values{index}", each.type))
            offset += each.type.itemsize
        else:
            length, offset = _read_length(data, offset, each)
            fields += [(f"length{index}", each.count_type), (f"values{index}", each.type, (length,))]
            offset += length * each.type.itemsize
    return np.dtype(fields)


def _read_rows(data: bytes, offset: int, element: _Element) -> tuple[dict[str, Column], int]:
    """Do as :func:`_read_element` where lists differ in length."""
    lists: list[list[NDArray[Any]]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for each, values in zip(element.properties, lists, strict=True):
            length, offset = (1, offset) if each.count_type is None else _read_length(data, offset, each)
            values.append(_take(data, offset, each.type, length))
            offset += length * each.type.itemsize
    properties = zip(element.properties, lists, strict=True)
    columns = [np.concatenate(values) if each.count_type is None else values for each, values in properties]
    return _named(columns, element), offset


def _named(columns: Sequence[Column], element: _Element) -> dict[str, Column]:
    """Name the columns, and make integers again of what the text of an ASCII file was read as."""
    named: dict[str, Column] = {}
    for each, column in zip(element.properties, columns, strict=True):
        if each.is_integer and isinstance(column, np.ndarray) and column.dtype.kind == "f":
            column = column.astype(np.int64)
        named[each.name] = column
    return named


def _read_length(data: bytes, offset: int, each: _Property) -> tuple[int, int]:
    """Read the length of a list, and find where its values start."""
    assert each.count_type is not None
    length = int(_take(data, offset, each.count_type, 1)[0])
    offset += each.count_type.itemsize
    if length < 0:
        raise InputError(f"damaged: a list '{each.name}' of {length:,} values: export it again")
    check_size(length * each.type.itemsize, len(data) - offset, f"a list '{each.name}' of {length:,} values")
    return length, offset


def _take(data: bytes, offset: int, kind: np.dtype[Any], count: int) -> NDArray[Any]:
    check_size(count * kind.itemsize, len(data) - offset, "more rows")
    return np.frombuffer(data, kind, count, offset)


def _faces(face: dict[str, Column]) -> NDArray[np.int64]:
    for name in ("vertex_indices", "vertex_index"):
        if name in face:
            polygons = face[name]
            return fan(polygons) if isinstance(polygons, np.ndarray) else triangles(polygons)
    return np.empty((0, 3), np.int64)
