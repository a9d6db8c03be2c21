"""What a report says of how it came about: when, from which files, with which options."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from idam import __version__
from idam.io import PointCloud

__all__ = ["Record"]


@dataclass(frozen=True)
class Record:
    """How a registration or a view came about.

    Attributes:
        bytes: sizes of the source's and the target's file; None for what is no file.
        options: by name, with those that are left out as None.
        unit: of the files' coordinates, such as ``m``; empty where it is not known.
        date: of the report; now, in UTC, unless the environment's SOURCE_DATE_EPOCH fixes it.
    """

    bytes: tuple[int | None, int | None] = (None, None)
    options: Mapping[str, Any] = field(default_factory=dict)
    unit: str = ""
    date: datetime = field(default_factory=lambda: _now())

    @classmethod
    def of(cls, source: Path, target: Path, *, unit: str = "", options: Mapping[str, Any] | None = None) -> Record:
        """The record of two files."""
        return cls((_size(source), _size(target)), options or {}, unit)

    @property
    def lengths(self) -> str:
        """What lengths are in."""
        return self.unit or "units of the files"

    @property
    def made(self) -> str:
        """When, and by what version."""
        return f"{self.date:%Y-%m-%d %H:%M} UTC, idam {__version__}"

    def of_files(self, names: tuple[str, str], clouds: tuple[PointCloud, PointCloud]) -> list[tuple[str, str]]:
        """What is known of the files, as labels and values."""
        return [
            (what, ", ".join([name, *([] if size is None else [f"{size:,} bytes"]), f"{len(cloud.points):,} points"]))
            for what, name, size, cloud in zip(("Source", "Target"), names, self.bytes, clouds, strict=True)
        ]

    def of_run(self) -> list[tuple[str, str]]:
        """When, by what, with which options, as labels and values."""
        options = [f"{name} {value}" for name, value in self.options.items() if value is not None]
        return [
            ("Unit of lengths", self.lengths),
            *([("Options", ", ".join(options))] if options else []),
            ("Date", f"{self.date:%Y-%m-%d %H:%M} UTC"),
            ("idam", __version__),
        ]


def _size(file: Path) -> int | None:
    """The size of a file in bytes, where it is one."""
    try:
        return file.stat().st_size if file.is_file() else None
    except (OSError, ValueError):
        return None


def _now() -> datetime:
    """The time, or what SOURCE_DATE_EPOCH says, by which builds are made reproducible."""
    fixed = os.environ.get("SOURCE_DATE_EPOCH", "")
    return datetime.fromtimestamp(int(fixed), timezone.utc) if fixed.isdigit() else datetime.now(timezone.utc)
