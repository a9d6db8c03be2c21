"""The scans to merge: read, named, and made ready."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import io, rigid
from idam.clouds.prepared import SMALL, Prepared
from idam.clouds.surfaces import spacing_of
from idam.errors import InputError, MissingDependencyError
from idam.io import PointCloud, as_point_cloud, is_readable
from idam.io.files import check_source
from idam.many.names import told_apart
from idam.models import resolve
from idam.registration import prepared
from idam.rigid import Array

__all__ = ["Scan", "Thinned", "described", "read_scans", "spacing", "thinned"]

THINNED = 5000
"""Points of a scan at most that the joint refinement uses."""
SOME = 10
"""Scans at most that tell the spacing of all."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan that can be registered.

    Attributes:
        name: what messages and files call it.
        cloud: as given.
        prepared: all that depends on it alone.
        pose: (4, 4) that its file brings, to the frame of the file's scans, or None.
    """

    name: str
    cloud: PointCloud
    prepared: Prepared
    pose: Array | None = None

    @cached_property
    def fingerprint(self) -> str:
        """Tells this scan's points from any other's."""
        return hashlib.sha256(np.ascontiguousarray(self.cloud.points).tobytes()).hexdigest()[:16]

    @property
    def to_centre(self) -> Array:
        """The transform (4, 4) from coordinates relative to the centre to the scan's own."""
        return rigid.transform(np.eye(3), self.prepared.centre)


@dataclass(frozen=True, eq=False)
class Thinned:
    """A scan on a voxel grid, relative to its centre, in working units.

    Attributes:
        points: (N, 3).
        normals: (N, 3), of either sign unless ``faces``.
        tree: small_gicp's search tree of the points.
        spacing: the median distance of neighbouring points.
        faces: whether normals point to where the scan was seen from, as far as the scans show.
    """

    points: Array
    normals: Array
    tree: Any
    spacing: float
    faces: bool


def thinned(scans: Sequence[Scan], unit: float) -> list[Thinned]:
    """All scans on one grid, that of the scan which needs the largest voxels.

    Where most show that they come in their scanner's frame, all count as doing so, since they are of one kind: of 100
    sparse scans of a building 22 did not, and the two faces of its walls pulled on each other (0.38 m off; 0.04 now).
    """
    voxel_size = max(scan.prepared.voxel_size(THINNED) for scan in scans)
    shown = [scan.prepared.eye is not None for scan in scans]
    most = 2 * sum(shown) > len(scans)
    return [_thinned(scan.prepared, voxel_size, unit, most or own) for scan, own in zip(scans, shown, strict=True)]


def _thinned(prepared: Prepared, voxel_size: float, unit: float, faces: bool) -> Thinned:
    level = prepared.level(voxel_size)
    surface = level.surface(unit)
    points, normals = surface.points, surface.normals
    if faces:
        eye = -prepared.centre / unit
        away = ((eye - points) * normals).sum(1, keepdims=True) < 0
        normals = np.where(away, -normals, normals)
    return Thinned(points, normals, surface.tree, level.spacing / unit, faces)


def spacing(scans: Sequence[Scan]) -> float:
    """The median distance of neighbouring points of the scans, of some of these, in input units."""
    some = scans[:: len(scans) // SOME + 1]
    return float(np.median([spacing_of(scan.prepared.base) for scan in some]))


def described(scans: Sequence[Scan]) -> tuple[list[Array], list[NDArray[np.float32]], float]:
    """Points (N, 3) and features (N, K) of all scans on one grid, and the spacing of the points."""
    descriptor = resolve("default").descriptor
    voxel_size = float(np.median([scan.prepared.voxel_size(SMALL) for scan in scans]))
    levels = [scan.prepared.level(voxel_size) for scan in scans]
    rung = int(np.median([level.spacing_rung for level in levels]))
    spacing = float(np.median([level.spacing for level in levels]))
    return [level.points for level in levels], [level.described(descriptor, rung) for level in levels], spacing


def read_scans(scans: Iterable[Any], strict: bool = False) -> tuple[list[str], list[Scan | str]]:
    """Read the scans, and check that each can be registered.

    Args:
        scans: paths, folders, or what :func:`idam.register` takes. A file of several scans stands for all of them.
        strict: whether a scan that cannot be used is an error.

    Returns:
        The names of all scans, and for each the scan, or in one line why there is none.

    Raises:
        InputError: there are no two scans, two have one name, or, if strict, one cannot be used.
    """
    names: list[str] = []
    read: list[Scan | str] = []
    for name, load in sources(scans):
        found: list[Scan | str] = []
        try:
            found += [ready(*each) for each in load()]
        except (InputError, MissingDependencyError) as error:
            if strict:
                raise
            found = [str(error) if name in str(error) else f"{name}: {error}"]
        names += [scan.name if isinstance(scan, Scan) else name for scan in found]
        read += found
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name}: {names.count(name)} scans have this name: rename them, or give each just once")
    usable = sum(isinstance(scan, Scan) for scan in read)
    if usable < 2:
        faults = "".join(f"; {scan}" for scan in read if isinstance(scan, str))
        raise InputError(f"merging takes at least 2 scans that can be used, here are {usable}{faults}")
    return names, read


def sources(scans: Iterable[Any]) -> Iterator[tuple[str, Callable[[], list[tuple[str, Any, Array | None]]]]]:
    """What each entry is called, and how its scans are read, each with its name and pose.

    A folder stands for the files in it. A file is called by its name, with as many of its folders as tell it from other
    files of that name; anything else by its number.
    """
    entries: list[Any] = []
    for data in [scans] if isinstance(scans, (str, os.PathLike)) else scans:
        if isinstance(data, (str, os.PathLike)):
            entries += clouds_in(Path(data)) if Path(data).is_dir() else [Path(data)]
        else:
            entries.append(data)
    names = iter(told_apart([entry for entry in entries if isinstance(entry, Path)]))
    for number, data in enumerate(entries):
        if isinstance(data, Path):
            name = next(names)
            yield name, partial(scans_of, data, name)
        else:
            name = f"scan{number:03d}"
            yield name, partial(list, [(name, data, None)])


def scans_of(file: Path, name: str) -> list[tuple[str, Any, Array | None]]:
    """The scans of a file, with their names and poses."""
    check_source(file)
    return [(name + scan.name.removeprefix(file.name), scan.cloud, scan.pose) for scan in io.read_scans(file)]


def ready(name: str, data: Any, pose: Array | None) -> Scan:
    """A scan with all that depends on it alone; raise InputError where it cannot be registered."""
    if isinstance(data, Prepared):
        return Scan(name, PointCloud(data.points), data)
    cloud = as_point_cloud(data, nan="drop")
    return Scan(name, cloud, prepared(cloud.points, name), pose)


def clouds_in(folder: Path) -> list[Path]:
    """The point clouds in a folder, in the order of their names."""
    files = sorted(file for file in folder.iterdir() if is_readable(file) and file.is_file())
    if not files:
        raise InputError(f"{folder}: holds no file of a point cloud: name the scans themselves")
    return files
