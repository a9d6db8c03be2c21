"""Tables of numbers as text: XYZ, TXT, ASC, CSV and PTS."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, check_size, cloud_from_columns, cloud_from_table, has_positions

__all__ = ["decode", "encode_csv", "encode_pts", "encode_xyz"]

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_BEFORE_EMPTY_FIELD = re.compile(r",(?=[ \t]*(?:,|$))", re.MULTILINE)


def decode(data: bytes) -> PointCloud:
    """Read a text file with a point a line: coordinates, and what the header names or the columns look like.

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
    try:
        table = np.loadtxt(_separate_by_spaces(lines[first:]), np.float64, comments="#", ndmin=2)
    except ValueError as error:
        fault = str(error).partition(";")[0]
        raise InputError(
            f"damaged: {fault}, counted from its first point: mend that line or export it again"
        ) from error
    if table.shape[1] < 3:
        raise InputError(f"its lines hold {table.shape[1]} numbers, expected x y z: export it with coordinates")
    if count is not None:
        check_size(count, len(table), f"{count:,} points", "lines")
    if names is None:
        return cloud_from_table(table)
    return cloud_from_columns(dict(zip(names, table.T, strict=False)))


def encode_xyz(cloud: PointCloud) -> bytes:
    """Write lines of x y z, then red green blue, then the normal, as far as the cloud has them."""
    return _lines(_columns(cloud).values(), " ")


def encode_csv(cloud: PointCloud) -> bytes:
    """Do as :func:`encode_xyz`, separated by commas, under a line with the names of the columns."""
    columns = _columns(cloud)
    return ",".join(columns).encode() + b"\n" + _lines(columns.values(), ",")


def encode_pts(cloud: PointCloud) -> bytes:
    """Write the number of points, then lines of x y z, and intensity (0) red green blue if the cloud has colours."""
    columns = [*cloud.points.T]
    if cloud.colors is not None:
        columns += [np.zeros(len(cloud.points), np.uint8), *cloud.colors.T]
    return f"{len(cloud.points)}\n".encode() + _lines(columns, " ")


def _parse_header(lines: list[str]) -> tuple[list[str] | None, int | None, int]:
    """Find the names of columns and the number of points, if given, and which line holds the first point."""
    names = count = None
    for index, line in enumerate(lines):
        is_comment = line.lstrip().startswith("#")
        words = _words(line.lstrip(" \t#") if is_comment else line.partition("#")[0])
        if not words:
            continue
        if is_comment:
            names = words if words[0].casefold() == "x" and has_positions(words) else names
        elif not all(map(_is_number, words)):
            if not has_positions(words):
                raise InputError(f"line {index + 1} is neither numbers nor names of columns: write lines of x y z")
            names = words
        elif len(words) == 1 and count is None and words[0].isdecimal():
            count = int(words[0])
        else:
            return names if names is None or len(names) <= len(words) else None, count, index
    raise InputError("holds no points: export it again")


def _words(line: str) -> list[str]:
    """Split a line; an empty field between commas counts, so that names and numbers stay in step."""
    separator = ";" if ";" in line else "," if "," in line and not _has_decimal_commas(line) else None
    words = [word.strip() for word in line.split(separator)]
    while words and not words[-1]:
        words.pop()
    return words


def _has_decimal_commas(line: str) -> bool:
    return all(map(_DECIMAL_COMMA.fullmatch, line.split()))


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def _separate_by_spaces(lines: list[str]) -> list[str]:
    """Rewrite rows with commas or semicolons between fields, or decimal commas; empty fields become NaN."""
    first = lines[0].partition("#")[0]
    text = "\n".join(["", *lines])
    if ";" in first:
        text = text.replace(",", ".").replace(";", ",")
    elif _has_decimal_commas(first):
        return text.replace(",", ".").split("\n")
    elif "," not in first:
        return lines
    text = _BEFORE_EMPTY_FIELD.sub(",nan", text).replace("\n,", "\nnan,")
    return text.replace(",", " ").split("\n")


def _columns(cloud: PointCloud) -> dict[str, Numbers]:
    columns: dict[str, Numbers] = dict(zip("xyz", cloud.points.T, strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    return columns


def _lines(columns: Iterable[Numbers], separator: str) -> bytes:
    """Write a line a row, every number in the shortest form that reads back the same."""
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows).encode()
