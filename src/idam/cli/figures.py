"""``idam figures``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from idam.cli.shared import Data, tell

__all__ = ["figures"]


def figures(
    output: Annotated[Path, typer.Argument(help="Folder for the figures, each as PNG and SVG.")],
    data: Data,
    scans: Annotated[
        list[Path] | None,
        typer.Option("--scan", help="Scans to register, by the network alone: source, target, source, ..."),
    ] = None,
    speed: Annotated[
        Path | None, typer.Option(help="Times to plot, a file that benchmarks/speed.py --json wrote.")
    ] = None,
    model: Annotated[str, typer.Option(help="Weights for the figures with noise.")] = "gnn-gaussian-noise",
) -> None:
    r"""Draw the figures of the paper's appendix B and curves of error, validity and speed. Needs idam\[lab].

    [bold]Example[/bold]

      idam figures out --data modelnet40 --scan bun045.ply --scan bun000.ply
    """
    from idam.lab.figures import draw_figures

    for path in draw_figures(output, data, scans=scans or (), speed=speed, model=model, progress=tell):
        print(path)
