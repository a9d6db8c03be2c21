"""The shipped example: two views of a CAD part, registered and written out to look at."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from idam.io import make_folder, read_point_cloud, write_point_cloud, write_transform
from idam.registration import register
from idam.report.page import write_report
from idam.report.record import Record
from idam.result import RegistrationResult

__all__ = ["run", "scans"]


def scans() -> tuple[Path, Path]:
    """The files of the shipped scans: a machine part of 0.4 m, seen by a depth camera from 60 degrees apart."""
    folder = Path(str(resources.files("idam.demo")))
    return folder / "source.ply", folder / "target.ply"


def run(output: Path) -> tuple[RegistrationResult, dict[str, Path]]:
    """Register the shipped scans, and write the page, the aligned cloud and the transform to a folder.

    Raises:
        InputError: the folder cannot be made or written.
    """
    make_folder(output)
    source, target = scans()
    clouds = read_point_cloud(source), read_point_cloud(target)
    record = Record.of(source, target, unit="m")
    result = register(*clouds)
    files = {"page": output / "demo.html", "aligned": output / "aligned.ply", "transform": output / "transform.txt"}
    write_report(files["page"], *clouds, result, source_name="source.ply", target_name="target.ply", record=record)
    write_point_cloud(files["aligned"], clouds[0].transformed(result.transformation))
    write_transform(files["transform"], result.transformation)
    return result, files
