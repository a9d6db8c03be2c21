"""PTX, Leica's gridded scans, each with its pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import check_size, finite_cloud, log, parse_numbers

__all__ = ["decode"]

_HEADER = 10  # lines: columns, rows, the scanner's place and three axes, and a 4x4 whose last row is the translation


def decode(data: bytes) -> list[tuple[PointCloud, NDArray[np.float64]]]:
    """Read each scan's points, in the scanner's frame, and the pose (4, 4) that takes them to the common one.

    Points at 0 0 0, which the scanner did not see, are left out.

    Raises:
        InputError: the file is damaged, or a scan holds no points.
    """
    lines = [line for line in data.splitlines() if line.strip()]
    scans, at = [], 0
    while at < len(lines):
        check_size(_HEADER, len(lines) - at, "another scan", "lines")
        try:
            count = int(lines[at]) * int(lines[at + 1])
        except ValueError:
            raise InputError("not a PTX file (it does not begin with two counts): check what it is") from None
        matrix = parse_numbers(b"\n".join(lines[at + 6 : at + _HEADER])).reshape(4, 4)
        at += _HEADER
        if count < 1:
            raise InputError(f"damaged: a scan of {count:,} points: export it again")
        check_size(count, len(lines) - at, f"{count:,} points", "lines")
        table = parse_numbers(b"\n".join(lines[at : at + count])).reshape(count, -1)
        scans.append((_cloud(table), matrix.T.copy()))
        at += count
    if not scans:
        raise InputError("holds no points: export it again")
    return scans


def _cloud(table: NDArray[np.float64]) -> PointCloud:
    if table.shape[1] not in (3, 4, 7):
        raise InputError(f"damaged: its lines hold {table.shape[1]} numbers, not x y z intensity red green blue")
    seen = (table[:, :3] != 0).any(axis=1)
    if not seen.all():
        log.info("left out %s points that the scanner did not see", f"{np.count_nonzero(~seen):,}")
    table = table[seen]
    colors = table[:, 4:].astype(np.int64) if table.shape[1] == 7 else None
    return finite_cloud(table[:, :3], colors, None, {"intensity": table[:, 3]} if table.shape[1] > 3 else {})
