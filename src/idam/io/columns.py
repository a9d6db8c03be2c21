"""From columns of numbers to a point cloud: which are coordinates, which colours, which normals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud

__all__ = [
    "Numbers",
    "check_size",
    "cloud_from_columns",
    "cloud_from_table",
    "finite_cloud",
    "has_positions",
    "parse_numbers",
    "positions",
]

Numbers = NDArray[Any]

_POSITIONS = (("x", "y", "z"), ("points:0", "points:1", "points:2"))
_COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("rf", "gf", "bf"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normals:0", "normals:1", "normals:2"))

# Where a colour or a normal may start in a table without names: x y z and a triple; x y z intensity and a triple (PTS);
# x y z and two triples. With any other number of columns there is no telling.
_TRIPLES = {6: (3,), 7: (4,), 9: (3, 6)}


def has_positions(names: list[str]) -> bool:
    """Tell whether the names of columns say where the coordinates are."""
    known = {name.casefold() for name in names}
    return any(known.issuperset(triple) for triple in _POSITIONS)


def cloud_from_columns(columns: Mapping[str, Numbers]) -> PointCloud:
    """Find the cloud in named columns (N,), less the points that are not finite.

    Raises:
        InputError: there are no coordinates, or no finite ones.
    """
    return finite_cloud(positions(columns), _triple(columns, _COLORS), _triple(columns, _NORMALS))


def positions(columns: Mapping[str, Numbers]) -> Numbers:
    """Find the coordinates (N, 3) among named columns.

    Raises:
        InputError: there are none.
    """
    points = _triple(columns, _POSITIONS)
    if points is None:
        found = ", ".join(columns)[:60] or "none"
        raise InputError(f"has no columns x, y and z (found: {found}): export it with coordinates")
    return points


def cloud_from_table(table: Numbers) -> PointCloud:
    """Find the cloud in a table (N, 3 or more) without names: coordinates, then what looks like colours or normals.

    Raises:
        InputError: there are no finite coordinates.
    """
    colors = normals = None
    for start in _TRIPLES.get(table.shape[1], ()):
        triple = table[:, start : start + 3]
        if normals is None and _looks_like_normals(triple):
            normals = triple
        elif colors is None and _looks_like_colors(triple):
            colors = triple.astype(np.int64)
    return finite_cloud(table[:, :3], colors, normals)


def finite_cloud(points: Numbers, colors: Numbers | None, normals: Numbers | None) -> PointCloud:
    """Leave out the points with a NaN or infinite coordinate, which depth cameras write where they saw nothing.

    Raises:
        InputError: no point is left.
    """
    if not len(points):
        raise InputError("holds no points: export it again")
    points = points.astype(np.float64, copy=False)  # before the check: what an extended float holds, a double may not
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(f"every one of its {len(points):,} points is NaN or infinite: export it again")
    return PointCloud(
        points[finite],
        None if colors is None else _to_uint8(colors)[finite],
        None if normals is None else normals[finite].astype(np.float64),
    )


def parse_numbers(text: bytes) -> NDArray[np.float64]:
    """Read all numbers of a text separated by white space, line ends included."""
    return np.fromiter(map(float, text.split()), np.float64)


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


def _triple(columns: Mapping[str, Numbers], choices: tuple[tuple[str, str, str], ...]) -> Numbers | None:
    lower = {name.casefold(): values for name, values in columns.items()}
    for names in choices:
        if all(name in lower for name in names):
            return np.stack([lower[name] for name in names], axis=1)
    return None


def _looks_like_normals(triple: Numbers) -> bool:
    length = np.linalg.norm(triple, axis=1)
    unit = np.abs(length - 1) < 0.01
    return bool(unit.any() and (unit | (length == 0)).all())


def _looks_like_colors(triple: Numbers) -> bool:
    return bool(((triple >= 0) & (triple <= 255) & (triple == np.round(triple))).all())


def _to_uint8(colors: Numbers) -> NDArray[np.uint8]:
    """Colours of 0 to 255, of 0 to 1 if they are fractions, or of 0 to 65535 if they go that far."""
    if colors.dtype == np.uint8:
        return colors
    values = np.nan_to_num(colors.astype(np.float64))
    if colors.dtype.kind == "f" and values.max(initial=0) <= 1:
        values *= 255
    elif values.max(initial=0) > 255:
        values /= 257
    return np.round(values.clip(0, 255)).astype(np.uint8)
