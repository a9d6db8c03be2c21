"""PLY, the Stanford polygon format: ASCII, and binary of both byte orders."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.errors import InputError
from idam.io.cloud import Mesh, PointCloud
from idam.io.columns import (
    check_is_binary,
    check_size,
    finite,
    named_cloud,
    parse_numbers,
    whole_as_integers,
    without_windows_nan,
    words_in_lines,
)
from idam.io.mesh import coordinate_type, fan, mesh_or_cloud, triangles
from idam.io.names import normal_names, position_names

__all__ = ["decode", "encode", "move"]

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
_LINE_END = re.compile(rb"ply[ \t]*(\r\n|\n\r|\n|\r)")
_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(?=[\r\n]|$)")

Column = NDArray[Any] | list[NDArray[Any]]  # a list: of lists that differ in length, one array a row


@dataclass(frozen=True)
class _Property:
    name: str
    type: np.dtype[Any]  # as it is read: of a text, every number is a double
    declared: np.dtype[Any]
    count_type: np.dtype[Any] | None = None  # of a list's length, as it is read; None: not a list
    declared_count: np.dtype[Any] | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def decode(data: bytes) -> PointCloud | Mesh:
    """Read the points of a PLY file, or the mesh if it has faces.

    Raises:
        InputError: the file is damaged, or has no vertices.
    """
    _, columns = _read(data)
    vertex = {name: column for name, column in columns.get("vertex", {}).items() if isinstance(column, np.ndarray)}
    vertex = {name: column for name, column in vertex.items() if column.ndim == 1}
    faces = _faces(columns.get("face", {}))
    return mesh_or_cloud(named_cloud(vertex), faces) if len(faces) else finite(named_cloud(vertex))


def encode(content: PointCloud | Mesh) -> bytes:
    """Encode a binary little endian PLY file; coordinates are doubles where floats would round them too much."""
    cloud = content.vertices if isinstance(content, Mesh) else content
    kind = coordinate_type(cloud.points)
    columns = dict(zip("xyz", cloud.points.T.astype(f"<{kind}"), strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T.astype("<f4"), strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    for name, values in cloud.attributes.items():
        columns.setdefault("_".join(name.split()) or "unnamed", _storable(values))
    properties = [_Property(name, values.dtype, values.dtype) for name, values in columns.items()]
    elements = [_Element("vertex", len(cloud.points), properties)]
    tables: dict[str, dict[str, Column]] = {"vertex": dict(columns)}
    if isinstance(content, Mesh):
        kinds = np.dtype("<i4"), np.dtype("u1")
        corners = _Property("vertex_indices", kinds[0], kinds[0], kinds[1], kinds[1])
        elements.append(_Element("face", len(content.faces), [corners]))
        tables["face"] = {"vertex_indices": content.faces}
    return _write(elements, tables)


def move(data: bytes, transformation: rigid.Array) -> bytes:
    """Move the vertices of a file by a rigid transform (4, 4); all its other elements and properties stay.

    Raises:
        InputError: the file is damaged, or has no vertices.
    """
    elements, columns = _read(data)
    vertex: dict[str, Any] = columns.get("vertex", {})
    alone = [name for name, column in vertex.items() if isinstance(column, np.ndarray) and column.ndim == 1]
    names, normals = position_names(alone), normal_names(alone)
    moved = rigid.apply(transformation, np.stack([vertex[name].astype(np.float64) for name in names], axis=1))
    kind = np.dtype("<" + coordinate_type(moved))
    vertex |= dict(zip(names, moved.T, strict=True))
    if normals is not None:
        turned = np.stack([vertex[name] for name in normals], axis=1) @ transformation[:3, :3].T
        vertex |= dict(zip(normals, turned.T, strict=True))
    for element in elements:
        for place, each in enumerate(element.properties):
            if (
                each.declared.kind in "iu"
                and getattr(columns[element.name][each.name], "dtype", each.declared).kind == "f"
            ):
                element.properties[place] = replace(each, declared=np.dtype("<f8"))  # fractions in a text
        if element.name == "vertex":
            for place, each in enumerate(element.properties):
                if each.name in names and each.declared != np.float64:
                    element.properties[place] = replace(each, declared=kind)
                elif normals is not None and each.name in normals and each.declared.kind != "f":
                    element.properties[place] = replace(each, declared=np.dtype("<f4"))
    return _write(elements, columns)


def _read(data: bytes) -> tuple[list[_Element], dict[str, dict[str, Column]]]:
    """Read all elements of a file, and the columns of each."""
    elements, is_ascii, offset = _parse_header(data)
    body = data[offset:]
    if not is_ascii:
        check_is_binary(body)
        return elements, _read_elements(data, offset, elements, "bytes")[0]
    body = without_windows_nan(body)  # one decoder for both: text becomes a file in which every type is a double
    fault = InputError("damaged: it holds more numbers than its header says: export it again")
    if not _lines_differ(body, elements):
        numbers = parse_numbers(body).tobytes()
        try:
            columns, end = _read_elements(numbers, 0, elements, "numbers")
            if end == len(numbers):
                return elements, columns
        except InputError as error:
            fault = error
    try:  # surplus numbers: then what counts is where the lines end
        return elements, _read_elements(_first_of_lines(body, elements).tobytes(), 0, elements, "numbers")[0]
    except (InputError, ValueError, IndexError):
        raise fault from None


def _lines_differ(body: bytes, elements: list[_Element]) -> bool:
    """Whether there is a line a row, but lines of vertices differ in how many numbers they hold."""
    words = words_in_lines(body)
    if len(words) != sum(element.count for element in elements):
        return False
    at = 0
    for element in elements:
        if element.name == "vertex" and all(each.count_type is None for each in element.properties):
            return bool((words[at : at + element.count] != len(element.properties)).any())
        at += element.count
    return False


def _read_elements(
    data: bytes, offset: int, elements: list[_Element], unit: str
) -> tuple[dict[str, dict[str, Column]], int]:
    columns: dict[str, dict[str, Column]] = {}
    for element in elements:
        columns[element.name], offset = _read_element(data, offset, element, unit)
    return columns, offset


def _first_of_lines(body: bytes, elements: list[_Element]) -> NDArray[np.float64]:
    """Take from each line of text the numbers that its row needs, and leave out those after them."""
    lines = [line for line in body.replace(b"\r", b"\n").split(b"\n") if line.strip()][::-1]
    kept: list[bytes] = []
    for element in elements:
        for _ in range(element.count):
            words, needed = lines.pop().split(), 0
            for each in element.properties:
                needed += 1 if each.count_type is None else 1 + int(float(words[needed]))
            if not 0 <= needed <= len(words):
                raise ValueError
            kept += words[:needed]
    return parse_numbers(b" ".join(kept))


def _write(elements: list[_Element], columns: dict[str, dict[str, Column]]) -> bytes:
    """Write a binary little endian file of these elements."""
    header, body = "ply\nformat binary_little_endian 1.0\n", b""
    names = {kind: name for name, kind in _C_NAMES.items()}
    for element in elements:
        header += f"element {element.name} {element.count}\n"
        for each in element.properties:
            lengths = "" if each.declared_count is None else f"list {names[each.declared_count.name]} "
            header += f"property {lengths}{names[each.declared.name]} {each.name}\n"
        body += _rows(element, columns[element.name])
    return f"{header}end_header\n".encode("latin-1", "replace") + body


def _rows(element: _Element, columns: dict[str, Column]) -> bytes:
    if element.count == 0 or not element.properties:
        return b""
    if any(isinstance(columns[each.name], list) for each in element.properties):  # lists that differ in length
        return b"".join(
            _packed(each, columns[each.name][row]) for row in range(element.count) for each in element.properties
        )
    fields: list[Any] = []
    for place, each in enumerate(element.properties):
        kind, values = each.declared.newbyteorder("<"), columns[each.name]
        if each.declared_count is None:
            fields.append((f"values{place}", kind))
        else:
            fields += [(f"length{place}", each.declared_count), (f"values{place}", kind, np.shape(values)[1:])]
    rows = np.empty(element.count, fields)
    for place, each in enumerate(element.properties):
        rows[f"values{place}"] = columns[each.name]
        if each.count_type is not None:
            rows[f"length{place}"] = np.shape(columns[each.name])[1]
    return rows.tobytes()


def _packed(each: _Property, values: Any) -> bytes:
    data = np.asarray(values).astype(each.declared.newbyteorder("<")).tobytes()
    if each.declared_count is None:
        return data
    return np.asarray(len(values), each.declared_count).tobytes() + data


def _storable(values: NDArray[Any]) -> NDArray[Any]:
    """Values in a type that PLY has."""
    kind = values.dtype
    if kind.kind == "b":
        return values.astype("u1")
    if kind.kind in "iu" and kind.itemsize == 8:
        small = len(values) == 0 or (values.min() >= -(2**31) and values.max() < 2**31)
        return values.astype("<i4" if small else "<f8")
    return values.astype(f"<{kind.kind}{min(kind.itemsize, 8)}" if kind.itemsize != 2 or kind.kind != "f" else "<f4")


def _parse_header(data: bytes) -> tuple[list[_Element], bool, int]:
    """Find the elements, whether they are written as text, and where they start."""
    line_end, end = _LINE_END.match(data), _END_OF_HEADER.search(data)
    if line_end is None or end is None:
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
    for element in elements:
        if len({each.name for each in element.properties}) < len(element.properties):
            raise InputError(f"damaged: its header names a property of '{element.name}' twice: export it again")
    if order is None:
        raise InputError("damaged: its header has no 'format' line: export it again")
    return elements, order == "", _start_of_data(data, end.end(), line_end[1])


def _start_of_data(data: bytes, at: int, line_end: bytes) -> int:
    """Step over one line end as the header has them: a byte more may be a number's."""
    if data.startswith(line_end, at):
        # a line feed, with a carriage return before it that the header's first line lacked
        return at + len(line_end)
    return at + (2 if data.startswith(b"\r\n", at) else 1)


def _property(name: str, order: str, kind: str, count_type: str | None = None) -> _Property:
    if count_type is None:
        return _Property(name, _type(kind, order), _type(kind, "<"))
    return _Property(name, _type(kind, order), _type(kind, "<"), _type(count_type, order), _type(count_type, "<"))


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
        if each.declared.kind in "iu" and isinstance(column, np.ndarray) and column.dtype.kind == "f":
            column = whole_as_integers(column)
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
