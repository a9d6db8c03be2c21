"""Tables of numbers as text: XYZ, TXT, ASC, CSV and PTS."""

from __future__ import annotations

import re
from itertools import chain

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns, cloud_from_table, has_positions

__all__ = ["decode", "encode_csv", "encode_pts", "encode_xyz"]

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_EMPTY_FIELD = re.compile(r"(?<=,)[ \t]*(?=,|$)", re.MULTILINE)


def decode(data: bytes) -> PointCloud:
    """The points of a text file with a point a line: coordinates, and what the header names or its columns look like.

    Columns stand apart by white space, commas or semicolons; ``#`` and ``//`` start a comment. The names of columns may
    stand in the first line, or in a comment before the first number, and the number of points before the first point.

    Raises:
        InputError: a line is no point, or there are no finite coordinates.
    """
    if b"\0" in data:
        raise InputError("not a text file (it holds zero bytes): check what it is")
    text = data.removeprefix(_BYTE_ORDER_MARK).decode("latin-1").replace("//", "#").replace('"', "")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    names, count, first = _parse_header(lines)
    rows = _separate_by_spaces(lines[first:])
    table = np.loadtxt(rows, np.float64, comments="#", ndmin=2)
    if table.shape[1] < 3:
        raise InputError(f"its lines hold {table.shape[1]} numbers, expected x y z: export it with coordinates")
    if count is not None:
        check_size(count, len(table), f"{count:,} points", "lines")
    if names is None:
        return cloud_from_table(table)
    if len(names) > table.shape[1]:
        raise InputError(f"its header names {len(names)} columns, its lines hold {table.shape[1]} numbers: mend it")
    return cloud_from_columns(dict(zip(names, table.T, strict=False)))


def encode_xyz(cloud: PointCloud) -> bytes:
    """Lines of x y z, then red green blue, then the normal, as far as the cloud has them."""
    return _lines(_columns(cloud).values(), " ")


def encode_csv(cloud: PointCloud) -> bytes:
    """As :func:`encode_xyz`, separated by commas, under a line with the names of the columns."""
    columns = _columns(cloud)
    return ",".join(columns).encode() + b"\n" + _lines(columns.values(), ",")


def encode_pts(cloud: PointCloud) -> bytes:
    """The number of points, then lines of x y z, and intensity (0) red green blue if the cloud has colours."""
    columns = [*cloud.points.T]
    if cloud.colors is not None:
        columns += [np.zeros(len(cloud.points), np.uint8), *cloud.colors.T]
    return f"{len(cloud.points)}\n".encode() + _lines(columns, " ")
