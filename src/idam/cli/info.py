"""``idam info``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from idam.cli.shared import left_out

if TYPE_CHECKING:
    from idam.io import PointCloud, Scan
    from idam.rigid import Array

__all__ = ["info"]

TRANSFORM_SUFFIXES = ("", ".txt", ".json", ".npy", ".tum", ".kitti", ".mat")


def info(file: Annotated[Path, typer.Argument(help="A cloud, a mesh or a transform.")]) -> None:
    """Say what FILE holds: points, extent, spacing, columns, scans, and what the reader leaves out.

    A transform is written in all the notations that people paste.
    """
    from idam.errors import InputError
    from idam.io import Mesh, read_content, read_transform

    if file != Path("-") and file.suffix.lower() in TRANSFORM_SUFFIXES:
        try:
            return show_transform(read_transform(file))
        except InputError:
            if file.suffix.lower() in ("", ".json", ".tum", ".kitti", ".mat"):
                raise
    with left_out() as remarks:
        content = read_content(file)
        line("file", f"{file}")
        if isinstance(content, Mesh):
            line("mesh", f"{len(content.faces):,} triangles")
            show_cloud(content.vertices, "vertices")
        elif len(content) == 1:
            show_cloud(content[0].cloud, "points")
            show_pose(content[0])
        else:
            line("scans", f"{len(content):,}")
            for scan in content:
                print()
                line("scan", scan.name)
                show_cloud(scan.cloud, "points")
                show_pose(scan)
    for remark in remarks:
        line("reader", remark)
    return None


def show_cloud(cloud: PointCloud, what: str) -> None:
    """Print the figures of a cloud, and its columns."""
    import numpy as np

    from idam.clouds.surfaces import spacing_of

    points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    line(what, f"{len(cloud.points):,}")
    low, high = points.min(axis=0), points.max(axis=0)
    for axis, least, most in zip("xyz", low, high, strict=True):
        line(f"  {axis}", f"{least:.10g} to {most:.10g}  ({most - least:.6g})")
    if (high > low).any():
        distance = spacing_of(points - points.mean(axis=0))
        line("spacing", f"{distance:.4g}  (median distance to the nearest neighbour)")
    line("unit", unit(low, high))
    if cloud.colors is not None:
        line("colours", "red, green, blue")
    if cloud.normals is not None:
        line("normals", "nx, ny, nz")
    for name, values in cloud.attributes.items():
        known = values[np.isfinite(values)]
        line(f"  {name}", f"{known.min():.10g} to {known.max():.10g}" if len(known) else "NaN")


def show_pose(scan: Scan) -> None:
    """Print where a file places a scan, if it does."""
    from idam.io import format_transform

    if scan.pose is not None:
        line("pose", format_transform(scan.pose, "quaternion"))


def show_transform(matrix: Array) -> None:
    """Print a transform in every notation."""
    import numpy as np

    from idam import rigid
    from idam.io import format_transform
    from idam.io.notations import FORMS

    line("transform", f"turns by {np.degrees(rigid.angle(matrix)):.6g} degrees")
    for form in FORMS:
        print(f"\n{form}\n{format_transform(matrix, form)}")


def unit(low: Array, high: Array) -> str:
    """A guess at the unit of coordinates, from where they are and how far they reach."""
    import numpy as np

    extent = float((high - low).max())
    if np.abs([low[:2], high[:2]]).max() > 1e5 and extent < 1e5:
        return "metres, by the look of it: coordinates of a national or UTM grid"
    if extent > 2000:
        return "millimetres, if it is a building or smaller"
    if extent < 2:
        return "metres, or scaled: an object or a normalised shape"
    return "metres, if it is a place; millimetres or inches, if it is an object"


def line(name: str, value: str) -> None:
    """Print a figure under its name."""
    print(f"{name:<12}{value}")
