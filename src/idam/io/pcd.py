"""PCD, the format of the Point Cloud Library: ASCII, binary and LZF-compressed binary."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import (
    check_is_binary,
    check_size,
    cloud_from_columns,
    log,
    parse_numbers,
    whole_as_integers,
    without_windows_nan,
    words_in_lines,
)
from idam.io.files import check_unpacked_size
from idam.io.mesh import coordinate_type

__all__ = ["decode", "encode", "unpack_colors"]

_END_OF_HEADER = re.compile(rb"^DATA[ \t]+(ascii|binary_compressed|binary)[ \t]*\r?$\n?", re.MULTILINE)
_PACKED_COLORS = ("rgb", "rgba")


@dataclass(frozen=True)
class _Header:
    names: list[str]
    types: list[np.dtype[Any]]
    counts: list[int]  # values of each field in a point
    points: int


def decode(data: bytes) -> PointCloud:
    """Read the points of a PCD file.

    Raises:
        InputError: the file is damaged, or has no finite coordinates.
    """
    match = _END_OF_HEADER.search(data)
    if match is None:
        raise InputError("not a PCD file (its header has no line DATA ascii, binary or binary_compressed)")
    header = _parse_header(data[: match.start()].decode("latin-1"))
    body = data[match.end() :]
    read = {b"ascii": _read_ascii, b"binary": _read_binary, b"binary_compressed": _read_compressed}[match[1]]
    columns = dict(zip(header.names, read(header, body), strict=True))
    wide = [name for name, count in zip(header.names, header.counts, strict=True) if count > 1 and name != "_"]
    if wide:
        log.info("left out fields of several numbers: %s", ", ".join(wide)[:200])
    return cloud_from_columns({name: values for name, values in unpack_colors(columns).items() if name not in wide})


def encode(cloud: PointCloud) -> bytes:
    """Encode a PCD file: binary with float32 coordinates, ASCII with doubles where those would be rounded too much.

    Doubles are ASCII because Open3D reads them as zeros, without a word, from a binary file.
    """
    coordinates = coordinate_type(cloud.points)
    fields = _fields(cloud, coordinates)
    rows = np.empty(len(cloud.points), [(name, f"<{code}") for name, code, _ in fields])
    for name, _, values in fields:
        rows[name] = values
    names, codes, _ = zip(*fields, strict=True)
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {' '.join(names)}\n"
        f"SIZE {' '.join(code[1] for code in codes)}\nTYPE {' '.join(code[0].upper() for code in codes)}\n"
        f"COUNT {' '.join('1' for _ in codes)}\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(rows)}\nDATA {'binary' if coordinates == 'f4' else 'ascii'}\n"
    ).encode()
    if coordinates == "f4":
        return header + rows.tobytes()
    return header + "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode()


def _fields(cloud: PointCloud, coordinates: str) -> list[tuple[str, str, NDArray[Any]]]:
    """List the name, type and values of each field of a file."""
    fields: list[tuple[str, str, NDArray[Any]]]
    fields = [(name, coordinates, values) for name, values in zip("xyz", cloud.points.T, strict=True)]
    if cloud.normals is not None:
        fields += [(f"normal_{axis}", "f4", values) for axis, values in zip("xyz", cloud.normals.T, strict=True)]
    if cloud.colors is not None:
        red, green, blue = cloud.colors.T.astype(np.uint32)
        fields.append(("rgb", "u4", red << 16 | green << 8 | blue))
    taken = {name for name, _, _ in fields} | set(_PACKED_COLORS)
    for name, values in cloud.attributes.items():
        word = "_".join(name.split()) or "unnamed"
        if word not in taken:
            kind = values.dtype.kind if values.dtype.kind in "iuf" else "u"
            size = min(max(values.dtype.itemsize, 4 if kind == "f" else 1), 8)
            fields.append((word, f"{kind}{size}", values))
    return fields


def _parse_header(text: str) -> _Header:
    entries = {words[0]: words[1:] for line in text.splitlines() if (words := line.split())}
    try:
        names = entries.get("FIELDS") or entries["COLUMNS"]
        kinds = [{"F": "f", "I": "i", "U": "u"}[kind] for kind in entries["TYPE"]]
        types = [np.dtype(f"<{kind}{int(size)}") for kind, size in zip(kinds, entries["SIZE"], strict=True)]
        counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
        size = [int(entries[name][0]) for name in ("WIDTH", "HEIGHT") if name in entries]
        points = int(entries["POINTS"][0]) if "POINTS" in entries else size[0] * size[1]
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputError("damaged: its header lacks FIELDS, SIZE, TYPE or POINTS: export it again") from error
    if not len(names) == len(types) == len(counts) or min(counts, default=0) < 1 or points < 0:
        raise InputError("damaged: FIELDS, SIZE, TYPE and COUNT in its header do not agree: export it again")
    if len(size) == 2 and size[0] * size[1] != points:
        raise InputError(
            f"its header says {points:,} points, but WIDTH {size[0]} and HEIGHT {size[1]}: correct one of them"
        )
    if len(set(names) - {"_"}) + names.count("_") < len(names):
        raise InputError("two of its FIELDS have the same name: rename one")
    return _Header(names, types, counts, points)


def _read_ascii(header: _Header, body: bytes) -> list[NDArray[Any]]:
    row = sum(header.counts)
    body = without_windows_nan(body)
    widths = words_in_lines(body)[: header.points]
    if (widths != row).any():
        odd = int(widths[widths != row][0])
        raise InputError(f"damaged: a line of {odd} numbers, where its FIELDS and COUNT say {row}: export it again")
    table = parse_numbers(body)
    check_size(header.points * row, len(table), f"{header.points:,} points", "numbers")
    table = table[: header.points * row].reshape(header.points, row)
    starts = np.cumsum([0, *header.counts[:-1]])
    return [_as_declared(table[:, start], kind) for start, kind in zip(starts, header.types, strict=True)]


def _as_declared(values: NDArray[np.float64], kind: np.dtype[Any]) -> NDArray[Any]:
    """Turn numbers read as doubles into integers if they are declared so; a float keeps the digits of the text."""
    return values if kind.kind == "f" else whole_as_integers(values)


def _read_binary(header: _Header, body: bytes) -> list[NDArray[Any]]:
    check_is_binary(body)
    _check_binary_size(header, len(body))
    fields = zip(header.types, header.counts, strict=True)
    layout = np.dtype([(f"{index}", kind, (count,)) for index, (kind, count) in enumerate(fields)])
    rows = np.frombuffer(body, layout, header.points)
    return [rows[name][:, 0] for name in layout.names or ()]


def _read_compressed(header: _Header, body: bytes) -> list[NDArray[Any]]:
    """Read compressed data, which hold one field after the other, not one point after the other."""
    check_size(8, len(body), "compressed data")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    check_size(packed, len(body) - 8, "compressed data")
    check_unpacked_size(unpacked, packed)
    _check_binary_size(header, unpacked)
    data = _decompress_lzf(body[8 : 8 + packed], unpacked)
    columns, offset = [], 0
    for kind, count in zip(header.types, header.counts, strict=True):
        values = np.frombuffer(data, kind, header.points * count, offset)
        columns.append(values.reshape(header.points, count)[:, 0])
        offset += values.nbytes
    return columns


def _check_binary_size(header: _Header, available: int) -> None:
    row = sum(kind.itemsize * count for kind, count in zip(header.types, header.counts, strict=True))
    check_size(header.points * row, available, f"{header.points:,} points")


def _decompress_lzf(data: bytes, size: int) -> bytes:
    """Unpack LZF: runs of literal bytes, and references (length, distance) to what came before."""
    out = bytearray()
    at = 0
    while at < len(data) and len(out) <= size:
        control = data[at]
        if control < 32:
            out += data[at + 1 : at + control + 2]
            at += control + 2
            continue
        length = control >> 5
        if length == 7:
            at += 1
            length += data[at]
        distance = ((control & 31) << 8) + data[at + 1] + 1
        at += 2
        if distance > len(out):
            raise InputError("damaged: its compressed data refer to what is not there: copy or export it again")
        _repeat(out, distance, length + 2)
    if len(out) != size:
        raise InputError(f"damaged: its data unpack to {len(out):,} bytes, not {size:,}: copy or export it again")
    return bytes(out)


def _repeat(out: bytearray, distance: int, length: int) -> None:
    """Append ``length`` bytes from ``distance`` back; what is appended may itself be repeated."""
    start = len(out) - distance
    block = out[start : start + length]
    out += (block * (length // len(block) + 1))[:length]


def unpack_colors(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Add red, green and blue for a field that holds them in the bytes of one number."""
    unpacked = dict(columns)
    for name in _PACKED_COLORS:
        if name in columns:
            values = columns[name]
            if values.dtype.kind == "f":
                values = values.astype(np.float32).view(np.uint32)
            bits = values.astype(np.int64)
            for color, shift in (("red", 16), ("green", 8), ("blue", 0)):
                unpacked[color] = (bits >> shift & 255).astype(np.uint8)
            del unpacked[name]
    unpacked.pop("_", None)  # padding
    return unpacked
