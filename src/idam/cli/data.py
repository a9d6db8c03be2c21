"""``idam data``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["data"]

data = typer.Typer(help="Download the data that models are trained and evaluated on.", no_args_is_help=True)


@data.callback()
def about_data() -> None:
    """Download the data that models are trained and evaluated on."""


@data.command()
def modelnet40(
    folder: Annotated[Path, typer.Argument(help="Where to put it; give the folder printed as --data.")],
    url: Annotated[str | None, typer.Option(help="Of the archive, if the usual address does not answer.")] = None,
    sha256: Annotated[str | None, typer.Option(help="Of the archive, to check before unpacking.")] = None,
) -> None:
    r"""Download ModelNet40 (435 MB) and unpack it. Needs idam\[lab].

    A broken download is resumed. A folder that has the data is checked.
    """
    from idam.lab.data.download import MODELNET40_URL, fetch_modelnet40

    with download_bar() as advance:
        found = fetch_modelnet40(folder, url or MODELNET40_URL, sha256, progress=advance)
    print(f"ModelNet40 is in {found}")


@contextmanager
def download_bar() -> Iterator[Callable[[int, int | None], None]]:
    """A bar of bytes on stderr, and the function that moves it."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

    console = Console(stderr=True)
    columns = BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
