"""``idam apply``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["apply"]


def apply(
    transform: Annotated[
        Path, typer.Argument(help="File of a transform: 4x4 text, JSON, NPY, or a pose as TUM, KITTI, ROS write it.")
    ],
    file: Annotated[Path, typer.Argument(help="The cloud or mesh to move, of any size.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Write the moved file here.")],
    inverse: Annotated[bool, typer.Option("--inverse", help="Move by the inverse instead.")] = False,
) -> None:
    """Move FILE by TRANSFORM, with everything that the output's format can hold.

    A mesh stays a mesh. Between LAS and LAZ every attribute stays, and the file may be larger than the memory.

    [bold]Examples[/bold]

      idam apply T.txt scan.laz -o moved.laz

      idam register scan1.ply scan2.ply -q | idam apply - photo.e57 -o moved.e57
    """
    from idam import rigid
    from idam.io import check_outputs, check_writable, move_file, read_transform

    check_writable(output)
    check_outputs([output], [transform, file])
    matrix = read_transform(transform)
    move_file(file, rigid.inverse(matrix) if inverse else matrix, output)
