"""PLY, the Stanford polygon format: ASCII, and binary of both byte orders."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import check_size, cloud_from_columns, parse_numbers, positions
from idam.io.mesh import fan, sample_surface, triangles

__all__ = ["decode", "encode"]

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
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
    """The points of a PLY file; if it has faces, points sampled on their surface.

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
    """A binary little endian PLY file with coordinates of type ``f4`` or ``f8``."""
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
    """The elements, whether they are written as text, and where they start."""
    end = _END_OF_HEADER.search(data)
    if not data.startswith((b"ply\n", b"ply\r", b"ply ")) or end is None:
        raise InputError("not a PLY file (no 'ply' ... 'end_header'): check what it is")
    order = None
    elements: list[_Element] = []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
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
    def dtype(kind: str) -> np.dtype[Any]:
        if kind not in _TYPES:
            raise InputError(f"damaged: its header has the unknown type '{kind[:60]}': export it again")
        return np.dtype(order + _TYPES[kind] if order else "<f8")

    return _Property(name, dtype(kind), _TYPES[kind][0] != "f", count_type and dtype(count_type))


def _read_element(data: bytes, offset: int, element: _Element, unit: str) -> tuple[dict[str, Column], int]:
    """The element's columns, and where the next one starts."""
    size = 8 if unit == "numbers" else 1
    least = element.count * sum((each.count_type or each.type).itemsize for each in element.properties)
    check_size(least // size, (len(data) - offset) // size, f"{element.count:,} rows of '{element.name}'", unit)
    if least == 0:
        return {each.name: np.empty(0) for each in element.properties}, offset

    layout = _layout_of_first_row(data, offset, element)
    if element.count * layout.itemsize <= len(data) - offset:
        rows = np.frombuffer(data, layout, element.count, offset)
        lengths = [rows[name] for name in layout.names or () if name.startswith("length")]
        if all((each == each[0]).all() for each in lengths):
            columns = {each.name: rows[f"values{index}"] for index, each in enumerate(element.properties)}
            return _integers(columns, element), offset + rows.nbytes
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
    """As :func:`_read_element`, where lists differ in length."""
    lists: dict[str, list[NDArray[Any]]] = {each.name: [] for each in element.properties}
    for _ in range(element.count):
        for each in element.properties:
            length, offset = (1, offset) if each.count_type is None else _read_length(data, offset, each)
            lists[each.name].append(np.frombuffer(data, each.type, length, offset))
            offset += length * each.type.itemsize
    columns: dict[str, Column] = {
        each.name: np.concatenate(lists[each.name]) if each.count_type is None else lists[each.name]
        for each in element.properties
    }
    return _integers(columns, element), offset


def _read_length(data: bytes, offset: int, each: _Property) -> tuple[int, int]:
    """The length of a list, and where its values start."""
    assert each.count_type is not None
    length = int(np.frombuffer(data, each.count_type, 1, offset)[0])
    offset += each.count_type.itemsize
    if not 0 <= length * each.type.itemsize <= len(data) - offset:
        raise InputError(f"damaged: a list '{each.name}' of {length:,} values: copy or export it again")
    return length, offset


def _faces(face: dict[str, Column]) -> NDArray[np.int64]:
    for name in ("vertex_indices", "vertex_index"):
        if name in face:
            polygons = face[name]
            return fan(polygons) if isinstance(polygons, np.ndarray) else triangles(polygons)
    return np.empty((0, 3), np.int64)
