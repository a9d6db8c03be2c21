"""``idam merge``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from idam.cli.shared import INTERRUPTED, UNSURE
from idam.errors import InputError

if TYPE_CHECKING:
    from idam.many.result import MergeResult

__all__ = ["merge"]


def merge(
    scans: Annotated[list[Path], typer.Argument(help="Files, or folders of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the poses, the model and the page.")],
    reference: Annotated[
        str | None, typer.Option(help="The scan whose frame the model has; the first if left out.")
    ] = None,
    voxel_size: Annotated[
        float | None, typer.Option(help="Resolution for matching; from the data if left out.")
    ] = None,
    partners: Annotated[
        int | None, typer.Option(help="Likely partners to register each scan with; all of up to 30 if left out.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes; one a core if left out.")] = None,
    threshold: Annotated[float, typer.Option(help="Confidence from which a pose counts as certain.")] = 0.9,
    poses: Annotated[Path | None, typer.Option(help="File of starting poses, as poses.json.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Stop at a scan that cannot be read.")] = False,
    no_cloud: Annotated[bool, typer.Option("--no-cloud", help="Do not write the merged cloud.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Register many scans into one model, and report those without a certain pose.

    Writes poses.json, poses.tum, poses.kitti, graph.g2o, transforms/, merged.ply and report.html. A run that was
    stopped continues with the pairs it has. The exit code is 0 if every scan has a certain pose, 1 if one has not or is
    held by a single link, and 2 for bad input.

    [bold]Examples[/bold]

      idam merge scans/*.ply -o out/

      idam merge scans/ -o out/ --reference scan01.ply --jobs 4
    """
    from idam.io import check_writable, make_folder
    from idam.many.files import KEPT, read_poses, write_merge
    from idam.many.merge import merge as run
    from idam.processes import cores
    from idam.report.merge import write_merge_report

    check_apart(scans, output)
    starting = None if poses is None else read_poses(poses)
    make_folder(output)
    check_writable(output / "merged.ply")
    try:
        with progress_shown(quiet) as progress:
            result = run(
                scans,
                reference=reference,
                voxel_size=voxel_size,
                partners=partners,
                jobs=cores() if jobs is None else jobs,
                threshold=threshold,
                poses=starting,
                strict=strict,
                keep=output / KEPT,
                progress=progress,
            )
    except KeyboardInterrupt:
        print("idam: interrupted: run the same command to go on", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None
    write_merge(output, result, cloud=not no_cloud)
    write_merge_report(output / "report.html", result)
    if not quiet:
        show(result, output)
    if not result.complete:
        raise typer.Exit(UNSURE)


def check_apart(scans: list[Path], output: Path) -> None:
    """Raise InputError where the model would lie among the scans: run again, it would be taken for one."""
    for scan in scans:
        folder = scan if scan.is_dir() else scan.parent
        if folder.resolve() == output.resolve():
            raise InputError(
                f"{output}: holds scans to merge: write to a folder of its own, such as {output / 'merged'}"
            )


def show(result: MergeResult, output: Path) -> None:
    """Print what is placed, what is not and why, and where the files are."""
    from idam.result import chance

    width = max(map(len, result.names))
    print(f"{'scan':<{width}}  component  confidence")
    for scan, name in enumerate(result.names):
        component = result.component_of(scan)
        where = "-" if result.poses[scan] is None else str(component)
        sure = "-" if result.poses[scan] is None else chance(result.confidence[scan])
        print(f"{name:<{width}}  {where:>9}  {sure:>10}  {result.reason[scan]}".rstrip())
    used = sum(link.used for link in result.links)
    placed = sum(result.poses[scan] is not None for scan in result.components[0])
    print(f"{placed} of {len(result.names)} scans in one frame, {used} of {len(result.links)} links used")
    print(f"time {result.seconds:.1f} s")
    print(f"look at {output / 'report.html'}")


@contextmanager
def progress_shown(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on a terminal's stderr."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        bar = bars.add_task("reading", total=None)
        yield lambda what, done, total: bars.update(bar, description=what, completed=done, total=total)
