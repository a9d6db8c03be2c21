"""The pairs among the scans of a folder, chosen as for a merge."""

from __future__ import annotations

from pathlib import Path

from idam.batch.pairs import Pair
from idam.clouds.prepared import FINE
from idam.errors import InputError, MissingDependencyError
from idam.io import PointCloud, is_readable
from idam.io.files import StrPath
from idam.many.choice import ALL_PAIRS, PARTNERS, likeliest
from idam.many.partners import all_pairs, likeliness
from idam.many.scans import Scan, described
from idam.registration import prepared

__all__ = ["pairs_within"]


def pairs_within(folder: StrPath, partners: int | None = None) -> list[Pair]:
    """Pairs of the scans in a folder: all of a few scans, and of many the likeliest.

    Args:
        folder: files of other kinds in it, and folders, are passed over.
        partners: for each scan so many, the likeliest by the descriptors; None for all pairs of up to 30 scans and
            4 partners for each of more.

    Raises:
        InputError: there are fewer than two scans.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{folder}: no such folder: check the path")
    files = sorted(file for file in place.iterdir() if is_readable(file) and file.is_file())
    if len(files) < 2:
        raise InputError(f"{folder}: {len(files)} scans in it: two or more are needed")
    every = partners is None and len(files) <= ALL_PAIRS
    base = str(place.absolute())
    return [
        Pair(f"{files[source].name} {files[target].name}", files[source].name, files[target].name, folder=base)
        for source, target in (all_pairs(len(files)) if every else choose_partners(files, partners))
    ]


def choose_partners(files: list[Path], partners: int | None) -> list[tuple[int, int]]:
    """For each scan its so many likeliest partners, as pairs in order.

    A scan that cannot be read gets one partner, so that a row says why.
    """
    scans: dict[int, Scan] = {}
    for number, file in enumerate(files):
        try:
            scans[number] = _thinned(file)
        except (InputError, MissingDependencyError):
            continue
    numbers = list(scans)
    chosen = set()
    if len(scans) > 1:
        scores = likeliness(*described(list(scans.values())))
        chosen = likeliest(scores, partners or PARTNERS, range(len(scans)), ())
    unread = [(number, number - 1 if number else 1) for number in range(len(files)) if number not in scans]
    return sorted([*((numbers[source], numbers[target]) for source, target in chosen), *unread])


def _thinned(file: Path) -> Scan:
    """A scan with no more points than choosing takes, so that thousands fit into memory."""
    whole = prepared(file, file.name)
    points = whole.level(whole.voxel_size(FINE)).points + whole.centre
    return Scan(file.name, PointCloud(points), prepared(points, file.name))
