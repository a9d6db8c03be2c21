"""``idam register``."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated

import typer

from idam.cli.shared import UNSURE, read, show
from idam.errors import InputError

__all__ = ["register"]

STANDARD = Path("-")


def register(
    source: Annotated[Path, typer.Argument(help="The cloud to move.")],
    target: Annotated[Path, typer.Argument(help="The cloud that stays.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the moved source here, with all that it holds.")
    ] = None,
    transform: Annotated[Path | None, typer.Option(help="Write the 4x4 matrix here.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the whole result here, as JSON.")] = None,
    html: Annotated[Path | None, typer.Option(help="Write a page that shows the result and opens offline.")] = None,
    save_plot: Annotated[
        Path | None, typer.Option(help="Draw the result as .png or .svg; needs idam\\[figures].")
    ] = None,
    model: Annotated[str, typer.Option(help="Name or file of the weights; see 'idam models'.")] = "default",
    init: Annotated[Path | None, typer.Option(help="File of a transform as a first guess.")] = None,
    max_angle: Annotated[float, typer.Option(help="Largest rotation of the answer, in degrees.")] = 180.0,
    voxel_size: Annotated[
        float | None, typer.Option(help="Resolution of the matches, in the clouds' unit; from the data if left out.")
    ] = None,
    max_correspondence_distance: Annotated[
        float | None, typer.Option(help="Distance for fitness and RMSE; from the data if left out.")
    ] = None,
    refine: Annotated[str, typer.Option(help="Fine alignment: gicp, plane, point, symmetric or none.")] = "gicp",
    seed: Annotated[int, typer.Option(help="Has no effect: nothing is drawn at random.")] = 0,
    device: Annotated[str, typer.Option(help="Where a network of the paper runs, such as cuda.")] = "cpu",
    unit: Annotated[str, typer.Option(help="Unit of the coordinates, such as m, for the page to name.")] = "",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the 4x4 alone, for scripts.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Report each step and its time on stderr.")] = False,
) -> None:
    """Register SOURCE to TARGET: print the transform and the probability that it is right.

    The files may be PLY, PCD, XYZ, TXT, CSV, PTS, PTX, E57, LAS, LAZ, BIN, NPY, NPZ, OBJ, STL, OFF or GLB, also
    packed as .gz; - is text from the standard input, or to the standard output. The exit code is 0 for a confident
    answer, 1 for one that is likely wrong and 2 for bad input.

    [bold]Examples[/bold]

      idam register scan1.ply scan2.ply

      idam register scan1.ply scan2.ply -o aligned.ply --transform T.txt --html look.html

      idam register scan1.ply scan2.ply -q > T.txt && echo "sure enough"
    """
    from idam import registration
    from idam.io import (
        check_outputs,
        check_writable,
        move_file,
        read_point_cloud,
        read_transform,
        write_json,
        write_point_cloud,
        write_transform,
    )

    # before the work, and before the first of them is written
    if output is not None:
        check_writable(output)
    outputs = output, transform, json, html, save_plot
    check_outputs(outputs, [path for path in (source, target, init) if path is not None])
    if save_plot is not None:
        check_drawable(save_plot)
    with steps_told(verbose), faults_named(source, target):
        reader = read_point_cloud if quiet or verbose else read  # the steps tell what it leaves out, too
        source_cloud, target_cloud = reader(source), reader(target)
        result = registration.register(
            source_cloud,
            target_cloud,
            model=model,
            init=None if init is None else read_transform(init),
            max_angle=max_angle,
            voxel_size=voxel_size,
            max_correspondence_distance=max_correspondence_distance,
            refine=refine,  # type: ignore[arg-type] # register says which there are
            seed=seed,
            device=device,
        )
    if output is not None and source == STANDARD:  # which has been read
        write_point_cloud(output, source_cloud.transformed(result.transformation))
    elif output is not None:
        move_file(source, result.transformation, output)
    if transform is not None:
        write_transform(transform, result.transformation)
    if json is not None:
        write_json(json, result.to_dict())
    if html is not None:
        from idam.report.page import write_report
        from idam.report.record import Record

        options = {"model": model, "init": init, "max-angle": max_angle, "voxel-size": voxel_size, "refine": refine}
        options |= {"max-correspondence-distance": max_correspondence_distance, "seed": seed}
        record = Record.of(source, target, unit=unit, options=options)
        names = {"source_name": source.name, "target_name": target.name}
        write_report(html, source_cloud, target_cloud, result, **names, record=record)
    if save_plot is not None:
        from idam.report.plot import write_plot

        write_plot(save_plot, source_cloud, target_cloud, result, source_name=source.name, target_name=target.name)
    with redirect_stdout(sys.stderr if STANDARD in outputs else sys.stdout):
        show(result, quiet)
    if not result.converged:
        raise typer.Exit(UNSURE)


def check_drawable(path: Path) -> None:
    """Raise before the work starts if a picture cannot be drawn there."""
    from idam.report.view import check_matplotlib

    if path.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"{path}: unknown picture format '{path.suffix}': the ones to draw are .png, .svg")
    check_matplotlib("a result")


@contextmanager
def faults_named(source: Path, target: Path) -> Iterator[None]:
    """Name the file in what is wrong with the source or the target."""
    try:
        yield
    except InputError as error:
        name, colon, what = str(error).partition(": ")
        file = {"source": source, "target": target}.get(name)
        if file is None:
            raise
        raise InputError(f"{file}{colon}{what}") from error


@contextmanager
def steps_told(verbose: bool) -> Iterator[None]:
    """Write what the steps log to stderr, if that is asked for."""
    log, handler = logging.getLogger("idam"), logging.StreamHandler()
    level = log.level
    if verbose:
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
