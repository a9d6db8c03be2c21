"""The look that all figures share, and how they are saved. Imports Matplotlib."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import style
from matplotlib.figure import Figure

from idam.io.files import write_bytes

__all__ = ["COLUMN", "PAGE", "look", "save", "save_as"]

PAGE = 4.8
"""Width of the paper's text in inches: printed as they are, the figures fit, and 8 point is 8 point."""
COLUMN = 3.4
"""Width of half a page in two columns."""

_SETTINGS: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.handlelength": 1.5,
    "legend.handletextpad": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "savefig.dpi": 300,
    "svg.hashsalt": "idam",
}


@contextlib.contextmanager
def look() -> Iterator[None]:
    """These settings, whatever the user's own are, which come back in the end."""
    with style.context("default"), matplotlib.rc_context(_SETTINGS):
        yield


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem``.png and ``stem``.svg, each whole or not at all.

    Raises:
        InputError: a file cannot be written.
    """
    written = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
    for path in written:
        save_as(figure, path)
    return written


def save_as(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, by the file's extension, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    kind = path.suffix.lower().removeprefix(".")
    stream = io.BytesIO()
    # without the date, the same bytes every time
    figure.savefig(stream, format=kind, metadata={"Date": None} if kind == "svg" else {})
    write_bytes(path, stream.getvalue())
