"""E57, terrestrial scanners' format of exchange: several scans in a file, each with its pose, through pye57."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.errors import InputError, MissingDependencyError
from idam.io.cloud import PointCloud
from idam.io.columns import Numbers, finite_cloud
from idam.io.files import one_line
from idam.io.quaternion import quaternion, rotation

__all__ = ["check_installed", "encode", "encode_scans", "read"]

log = logging.getLogger("idam.io")

Placed = tuple[PointCloud, NDArray[np.float64]]

MOST_POINTS = 2**31
"""Points of a scan past which a file is refused: libE57 counts them in 32 bits on some systems."""

_CHUNK = 1_000_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_GRID = ("rowIndex", "columnIndex")
_STATES = ("cartesianInvalidState", "sphericalInvalidState")


def read(path: Path) -> list[Placed]:
    """Read each scan's valid points, in the scanner's frame, and its pose (4, 4).

    Raises:
        InputError: the file is damaged, or no scan holds a point.
        MissingDependencyError: pye57 is not installed.
    """
    check_installed()
    with path.open("rb") as stream:
        if stream.read(8) != b"ASTM-E57":
            raise InputError("not an E57 file: check what it is")
    import pye57

    try:
        image = pye57.libe57.ImageFile(str(path), "r")  # pye57.E57 would delete a file that it cannot read
    except Exception as error:
        raise InputError(f"damaged, or not E57 ({_reason(error)}): export it again") from error
    try:
        root = image.root()
        scans = root["data3D"] if root.isDefined("data3D") else []
        found = [scan for number in range(len(scans)) if (scan := _read_scan(image, scans[number], number + 1))]
    except pye57.libe57.E57Exception as error:
        raise InputError(f"damaged ({_reason(error)}): copy or export it again") from error
    finally:
        image.close()
    if not found:
        raise InputError("holds no points: export it again")
    return found


def encode(cloud: PointCloud) -> bytes:
    """Encode a file of one scan."""
    return encode_scans([(cloud, np.eye(4))])


def encode_scans(scans: Sequence[Placed]) -> bytes:
    """Encode scans, each with its pose (4, 4), colours, intensity, rows and columns; coordinates are float32.

    Raises:
        MissingDependencyError: pye57 is not installed.
    """
    check_installed()
    import pye57

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scans.e57"
        with pye57.E57(str(path), mode="w") as file:
            for number, (cloud, pose) in enumerate(scans, start=1):
                # the pose takes the centre, so that float32 holds what is left
                centre = np.round(cloud.points.mean(axis=0)) if len(cloud.points) else np.zeros(3)
                local = (cloud.points - centre).astype(np.float32).astype(np.float64)
                data: dict[str, Numbers] = dict(zip(_CARTESIAN, local.T, strict=True))
                if cloud.colors is not None:
                    data |= dict(zip(_COLORS, cloud.colors.T, strict=True))
                if "intensity" in cloud.attributes:
                    data["intensity"] = cloud.attributes["intensity"].astype(np.float32)
                if set(_GRID) <= set(cloud.attributes):
                    data |= {axis: cloud.attributes[axis].astype(np.uint16) for axis in _GRID}
                file.write_scan_raw(
                    {name: np.ascontiguousarray(values) for name, values in data.items()},
                    name=f"scan {number}",
                    rotation=quaternion(pose[:3, :3]),
                    translation=pose[:3, :3] @ centre + pose[:3, 3],
                )
        return path.read_bytes()


def check_installed() -> None:
    """Raise MissingDependencyError unless pye57 is there."""
    try:
        import pye57  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(".e57 files need pye57: pip install 'idam[e57]'") from error


def _read_scan(image: Any, scan: Any, number: int) -> Placed | None:
    points = scan["points"]
    count = points.childCount()
    if count >= MOST_POINTS:
        raise InputError(f"scan {number} has {count:,} points: export it in parts, or thinned")
    if count == 0:
        log.info("left out scan %d, which holds no points", number)
        return None
    columns = _columns(image, points, count, number)
    state = next((columns.pop(name) for name in _STATES if name in columns), np.zeros(count))
    if (state != 0).any():
        log.info("left out %s points of scan %d that are marked invalid", f"{np.count_nonzero(state):,}", number)
        columns = {name: values[state == 0] for name, values in columns.items()}
    if not len(next(iter(columns.values()))):
        log.info("left out scan %d, all points of which are marked invalid", number)
        return None
    coordinates = _points(columns, number)
    colors = np.stack([columns.pop(name) for name in _COLORS], axis=1) if set(_COLORS) <= set(columns) else None
    normals = np.stack([columns.pop(name) for name in _NORMALS], axis=1) if set(_NORMALS) <= set(columns) else None
    taken = {*_CARTESIAN, *_SPHERICAL}
    attributes = {name: values for name, values in columns.items() if name not in taken}
    cloud = finite_cloud(coordinates, None if colors is None else _colors(colors, points, scan), normals, attributes)
    return cloud, _pose(scan)


def _columns(image: Any, points: Any, count: int, number: int) -> dict[str, Numbers]:
    """All fields of numbers of a scan, as doubles."""
    import pye57

    prototype = pye57.libe57.StructureNode(points.prototype())
    names = [prototype.get(place).elementName() for place in range(prototype.childCount())]
    numeric = pye57.libe57.IntegerNode, pye57.libe57.ScaledIntegerNode, pye57.libe57.FloatNode
    kept = [name for name in names if isinstance(prototype[name], numeric)]
    if len(kept) < len(names):
        log.info("left out fields of scan %d: %s", number, ", ".join(sorted(set(names) - set(kept))))
    size = min(count, _CHUNK)
    chunk = {name: np.empty(size) for name in kept}
    buffers = pye57.libe57.VectorSourceDestBuffer()
    for name, values in chunk.items():
        buffers.append(pye57.libe57.SourceDestBuffer(image, name, values, size, True, True))
    reader = points.reader(buffers)
    parts: dict[str, list[Numbers]] = {name: [] for name in kept}
    while got := reader.read():
        for name, values in chunk.items():
            parts[name].append(values[:got].copy())
    return {name: np.concatenate(each) if each else np.empty(0) for name, each in parts.items()}


def _points(columns: dict[str, Numbers], number: int) -> Numbers:
    if set(_CARTESIAN) <= set(columns):
        return np.stack([columns[name] for name in _CARTESIAN], axis=1)
    if not set(_SPHERICAL) <= set(columns):
        raise InputError(f"scan {number} has no coordinates (its fields: {', '.join(columns)[:80]}): export it again")
    distance, azimuth, elevation = (columns[name] for name in _SPHERICAL)
    flat = distance * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _colors(colors: Numbers, points: Any, scan: Any) -> NDArray[np.uint8]:
    """Colours of 0 to 255, from the limits that the file names, or from their own range."""
    highest = 255.0
    if scan.isDefined("colorLimits") and scan["colorLimits"].isDefined("colorRedMaximum"):
        highest = float(scan["colorLimits"]["colorRedMaximum"].value())
    if not highest > 0 or colors.max(initial=0) > highest:
        highest = 255.0 if colors.max(initial=0) <= 255 else 65535.0
    return np.round(np.nan_to_num(colors) * (255 / highest)).clip(0, 255).astype(np.uint8)


def _reason(error: Exception) -> str:
    return one_line(error).partition(" ****")[0]  # libE57 says everything twice


def _pose(scan: Any) -> NDArray[np.float64]:
    if not scan.isDefined("pose"):
        return np.eye(4)
    turn, shift = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    pose = scan["pose"]
    if pose.isDefined("rotation"):
        turn = np.array([float(pose["rotation"][axis].value()) for axis in "wxyz"])
    if pose.isDefined("translation"):
        shift = np.array([float(pose["translation"][axis].value()) for axis in "xyz"])
    return rigid.transform(rotation(turn), shift)
