"""``idam view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from idam.cli.shared import read

__all__ = ["view"]


def view(
    source: Annotated[Path, typer.Argument(help="The cloud to move.")],
    target: Annotated[Path, typer.Argument(help="The cloud that stays.")],
    transform: Annotated[
        Path | None, typer.Argument(help="File of the transform; if left out, the clouds as they are.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Unit of the coordinates, such as m, for the page to name.")] = "",
    output: Annotated[Path, typer.Option("--output", "-o", help="Write the page here.")] = Path("view.html"),
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the page.")] = False,
) -> None:
    """Write a page with SOURCE and TARGET before and after a transform, and open it in the browser.

    [bold]Examples[/bold]

      idam view scan1.ply scan2.ply

      idam view scan1.ply scan2.ply T.txt -o look.html --no-open
    """
    import numpy as np

    from idam.io import check_outputs, read_transform
    from idam.report.page import write_view
    from idam.report.record import Record

    check_outputs([output], [path for path in (source, target, transform) if path is not None])
    matrix = np.eye(4) if transform is None else read_transform(transform)
    clouds = read(source), read(target)
    record = Record.of(source, target, unit=unit, options={"transform": transform})
    write_view(output, *clouds, matrix, source_name=source.name, target_name=target.name, record=record)
    print(f"look at {output}")
    if not no_open:
        typer.launch(str(output.resolve()))
