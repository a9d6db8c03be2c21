"""``idam demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from idam.cli.shared import show

__all__ = ["demo"]


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the page, the aligned cloud and the transform.")
    ] = Path("out"),
) -> None:
    """Align two shipped scans of a CAD part, seen by a depth camera from 60 degrees apart."""
    from idam.demo import run

    result, files = run(output)
    show(result)
    for what, path in files.items():
        print(f"{what:<12}{path}")
