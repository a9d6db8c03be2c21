"""What the commands share: exit codes, options, how a result is shown."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from idam.io import PointCloud
    from idam.result import RegistrationResult

__all__ = ["BAD_INPUT", "INTERRUPTED", "UNSURE", "Data", "left_out", "read", "show", "tell"]

UNSURE = 1
BAD_INPUT = 2
INTERRUPTED = 130

Data = Annotated[Path, typer.Option("--data", help="Folder of ModelNet40 (modelnet40_ply_hdf5_2048).")]


def read(path: Path) -> PointCloud:
    """Read a cloud, and say on stderr what of the file is left out."""
    from idam.io import read_point_cloud

    with left_out() as remarks:
        cloud = read_point_cloud(path)
    for remark in remarks:
        print(f"idam: {path}: {remark.removeprefix(f'{path}: ')}", file=sys.stderr)
    return cloud


@contextmanager
def left_out() -> Iterator[list[str]]:
    """What readers say that they left out."""
    remarks: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: remarks.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("idam.io")
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield remarks
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


def show(result: RegistrationResult, quiet: bool = False) -> None:
    """Print a result: the 4x4 as CloudCompare takes it, then, unless quiet, the motion, the figures and why.

    The 4x4 does not fit a cloud that CloudCompare shifted when it opened it (its "global shift"): there the moved file
    is what to open.
    """
    from idam.io import format_transform
    from idam.report.motion import motion_of
    from idam.result import chance

    print(format_transform(result.transformation))
    if quiet:
        return
    print("the same about the source's centroid: turn, then shift")
    for name, value in motion_of(result.transformation, result.clouds[0]).written():
        print(f"  {name:<10}{value}")
    print(f"fitness     {result.fitness:.3f}  (within {result.max_correspondence_distance:.4g})")
    print(f"inlier RMSE {result.inlier_rmse:.4g}")
    print(f"confidence  {chance(result.confidence)}")
    if result.reason:
        print(f"reason      {result.reason}")
    if result.remark:
        print(f"remark      {result.remark}")
    print(f"model       {result.model}")
    print(f"time        {result.seconds:.2f} s")


def tell(what: str) -> None:
    """Report progress on stderr, if that is a terminal."""
    if sys.stderr.isatty():
        print(what, file=sys.stderr)
