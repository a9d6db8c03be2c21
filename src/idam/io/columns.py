"""From columns of numbers to a point cloud: which are coordinates, which colours, which normals."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.names import color_names, normal_names, position_names

__all__ = [
    "Numbers",
    "check_is_binary",
    "check_size",
    "cloud_from_columns",
    "cloud_from_table",
    "finite",
    "finite_cloud",
    "log",
    "looks_like_colors",
    "looks_like_normals",
    "named_cloud",
    "parse_numbers",
    "parse_rows",
    "to_uint8",
    "unnamed_cloud",
    "whole_as_integers",
    "without_windows_nan",
    "words_in_lines",
]

Numbers = NDArray[Any]
log = logging.getLogger("idam.io")
"""What readers leave out is said here, at the level INFO; ``idam info`` shows it."""

MOST_COLUMNS = 16
"""Columns that a table without names may have even with fewer rows: scanners' exports have up to a dozen."""

# Where a colour or a normal may start in a table without names: x y z and a triple; x y z intensity and a triple (PTS);
# x y z and two triples. With any other number of columns there is no telling.
_TRIPLES = {6: (3,), 7: (4,), 9: (3, 6)}

# C runtimes of Windows write 1.#QNAN, -1.#IND, 1.#INF and, rounded, 1.#R or -1.$ ; newer ones -nan(ind); Excel #N/A.
_WINDOWS_NAN = re.compile(
    rb"[+-]?\d(?:\.[#$]\w*|,#(?:[QS]?NAN|IND|INF)\w*)|[+-]?nan\(\w*\)|"
    rb"#(?:N/A|NV\b|(?:NUM|DIV/0|VALUE|REF|WERT|ZAHL|BEZUG|VALEUR|NOMBRE|VALOR)!)",
    re.IGNORECASE,
)
_NUMBERS_AS_TEXT = re.compile(rb"[\s\d.eE+-]{24,}")


def cloud_from_columns(columns: Mapping[str, Numbers]) -> PointCloud:
    """Find the cloud in named columns (N,), less the points that are not finite.

    Raises:
        InputError: there are no coordinates, or no finite ones.
    """
    return finite(named_cloud(columns))


def named_cloud(columns: Mapping[str, Numbers]) -> PointCloud:
    """Find the cloud in named columns (N,), every point of it: what is no position, colour or normal keeps its name.

    Raises:
        InputError: there are no coordinates.
    """
    names = list(columns)
    places = position_names(names), color_names(names), normal_names(names)
    points, colors, normals = (
        None if found is None else np.stack([columns[name] for name in found], axis=1) for found in places
    )
    assert points is not None
    taken = {name for found in places if found for name in found}
    return _cloud(points, colors, normals, {name: columns[name] for name in names if name not in taken})


def cloud_from_table(table: Numbers) -> PointCloud:
    """Do as :func:`unnamed_cloud`, less the points that are not finite.

    Raises:
        InputError: there are no finite coordinates.
    """
    return finite(unnamed_cloud(table))


def unnamed_cloud(table: Numbers) -> PointCloud:
    """Find the cloud in a table (N, 3 or more) without names: coordinates, then what looks like colours or normals.

    Raises:
        InputError: its rows seem to be columns.
    """
    if table.shape[1] > max(MOST_COLUMNS, len(table)):
        raise InputError(f"holds {len(table)} rows of {table.shape[1]:,} numbers, expected a point a row: transpose it")
    colors = normals = None
    taken = {0, 1, 2}
    for start in _TRIPLES.get(table.shape[1], ()):
        triple = table[:, start : start + 3]
        if normals is None and looks_like_normals(triple):
            normals = triple
        elif colors is None and looks_like_colors(triple):
            colors = triple.astype(np.int64)
        else:
            continue
        taken |= {start, start + 1, start + 2}
    rest = {f"column_{index + 1}": table[:, index] for index in range(table.shape[1]) if index not in taken}
    return _cloud(table[:, :3], colors, normals, rest)


def finite_cloud(
    points: Numbers,
    colors: Numbers | None = None,
    normals: Numbers | None = None,
    attributes: Mapping[str, Numbers] | None = None,
) -> PointCloud:
    """Make a cloud of arrays as files have them, less the points that are not finite.

    Raises:
        InputError: no point is left.
    """
    return finite(_cloud(points, colors, normals, attributes or {}))


def finite(cloud: PointCloud) -> PointCloud:
    """Leave out the points with a NaN or infinite coordinate, which depth cameras write where they saw nothing.

    Raises:
        InputError: no point is left.
    """
    if not len(cloud.points):
        raise InputError("holds no points: export it again")
    rows = np.asarray(np.isfinite(cloud.points).all(axis=1))
    if rows.all():
        return cloud
    if not rows.any():
        raise InputError(f"every one of its {len(rows):,} points is NaN or infinite: export it again")
    log.info("left out %s points that are NaN or infinite", f"{np.count_nonzero(~rows):,}")
    return cloud.where(rows)


def _cloud(
    points: Numbers, colors: Numbers | None, normals: Numbers | None, attributes: Mapping[str, Numbers]
) -> PointCloud:
    return PointCloud(
        points.astype(np.float64, copy=False),  # what an extended float holds, a double may not
        None if colors is None else to_uint8(colors),
        None if normals is None else normals.astype(np.float64),
        attributes,
    )


def parse_numbers(text: bytes) -> NDArray[np.float64]:
    """Read all numbers of a text separated by white space, line ends included.

    Raises:
        InputError: a word is no number.
    """
    words = without_windows_nan(text).split()
    try:
        if b"_" not in text:  # which Python takes between digits
            return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        pass
    word = next(word for word in words if not _is_float(word)).decode("latin-1")
    raise InputError(f"damaged: '{word[:40]}' is no number: mend it, or export the file again")


def parse_rows(rows: Sequence[Sequence[bytes]], what: str) -> NDArray[np.float64]:
    """Read rows of words, as many in each, as numbers (N, width).

    Raises:
        InputError: a word is no number, or the rows differ in length.
    """
    width = len(rows[0]) if rows else 0
    short = next((row for row in rows if len(row) != width), None)
    if short is not None:
        raise InputError(f"damaged: {what} holds {len(short)} numbers, the first {width}: export it again")
    return parse_numbers(b" ".join(word for row in rows for word in row)).reshape(len(rows), width)


def words_in_lines(text: bytes) -> NDArray[np.int64]:
    """Count the words of each line of a text, empty lines left out."""
    letters = np.frombuffer(b" " + text + b"\n", np.uint8)
    is_space = letters <= 32
    starts = np.flatnonzero(is_space[:-1] & ~is_space[1:])
    ends = np.flatnonzero((letters[1:] == 10) | (letters[1:] == 13))
    counts = np.diff(np.searchsorted(starts, ends), prepend=0)
    return counts[counts > 0]


def whole_as_integers(values: NDArray[Any]) -> NDArray[Any]:
    """Make integers of a column that was read as floats; one with fractions or NaN stays as it is."""
    with np.errstate(all="ignore"):
        integers = values.astype(np.int64)
        return integers if (integers == values).all() else values


def check_is_binary(body: bytes) -> None:
    """Refuse text where a header promises bytes.

    Raises:
        InputError: it is text.
    """
    if _NUMBERS_AS_TEXT.fullmatch(body[:200]):
        raise InputError("damaged: its header says binary, but numbers follow as text: export it again")


def _is_float(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word


def without_windows_nan(text: bytes) -> bytes:
    """Spell numbers that are none in the way that Python reads them."""
    return _WINDOWS_NAN.sub(b"nan", text) if b"#" in text or b"$" in text or b"(" in text else text


def check_size(needed: int, available: int, what: str, unit: str = "bytes") -> None:
    """Refuse a file too short for what its header promises, before anything is allocated.

    Raises:
        InputError: it is too short.
    """
    if needed > available:
        raise InputError(
            f"cut short: its header promises {what}, at least {needed:,} {unit}, but {available:,} are there: "
            "copy or export it again"
        )


def looks_like_normals(triple: Numbers) -> bool:
    """Whether the rows (N, 3) are of length 1, or 0 where there is no normal."""
    length = np.linalg.norm(triple, axis=1)
    unit = np.abs(length - 1) < 0.01
    return bool(unit.any() and (unit | (length == 0)).all())


def looks_like_colors(triple: Numbers) -> bool:
    """Whether the rows (N, 3) are whole numbers of 0 to 255."""
    return bool(((triple >= 0) & (triple <= 255) & (triple == np.round(triple))).all())


def to_uint8(colors: Numbers) -> NDArray[np.uint8]:
    """Colours of 0 to 255, of 0 to 1 if they are fractions, or of 0 to 65535 if they go that far."""
    if colors.dtype == np.uint8:
        return colors
    values = np.nan_to_num(colors.astype(np.float64))
    if colors.dtype.kind == "f" and values.max(initial=0) <= 1:
        values *= 255
    elif values.max(initial=0) > 255:
        values /= 257
    return np.round(values.clip(0, 255)).astype(np.uint8)
