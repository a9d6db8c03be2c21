"""The pairs among the scans of a folder."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

from idam.batch.pairs import Pair
from idam.errors import InputError
from idam.io.files import StrPath
from idam.io.formats import READABLE

__all__ = ["pairs_within"]

FEW = 30
"""Scans up to which all pairs are taken."""


def pairs_within(folder: StrPath, partners: int | None = None) -> list[Pair]:
    """Pairs of the scans in a folder: all of them, or for each scan the likeliest so many.

    Args:
        folder: files of other kinds in it, and folders, are passed over.
        partners: for each scan; None for all pairs of up to 30 scans.

    Raises:
        InputError: there are fewer than two scans, or too many for all pairs of them.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{folder}: no such folder: check the path")
    scans = sorted(file.name for file in place.iterdir() if file.is_file() and file.suffix.lower() in READABLE)
    if len(scans) < 2:
        raise InputError(f"{folder}: {len(scans)} scans in it: two or more are needed")
    base = str(place.absolute())
    return [Pair(f"{scans[i]} {scans[j]}", scans[i], scans[j], folder=base) for i, j in _chosen(scans, partners)]


def _chosen(scans: list[str], partners: int | None) -> list[tuple[int, int]]:
    if partners is None and len(scans) > FEW:
        raise InputError(f"{len(scans)} scans: past {FEW} give the number of partners of each, such as --partners 8")
    return list(combinations(range(len(scans)), 2))
