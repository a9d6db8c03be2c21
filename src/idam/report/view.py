"""How clouds are looked at, on a page or in a plot: which points, how far apart, which way up."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import MissingDependencyError
from idam.rigid import Rows

__all__ = ["approach", "check_matplotlib", "frame", "guess_up", "sample"]

Points = NDArray[np.float64]


def check_matplotlib(what: str) -> None:
    """Raise MissingDependencyError where what is to be drawn, such as ``figures``, lacks Matplotlib."""
    if find_spec("matplotlib") is None:
        raise MissingDependencyError(f"drawing {what} needs Matplotlib: pip install 'idam[figures]'")


def sample(points: Points, count: int) -> Rows:
    """Rows of at most ``count`` finite ones of the points (N, 3), always the same, in their order."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(rows) <= count:
        return rows
    # at random: every n-th point of an ordered scan would leave stripes
    return np.asarray(rows[np.sort(np.random.default_rng(0).choice(len(rows), count, replace=False))])


def approach(local: list[Points], offset: Points) -> tuple[Points, float]:
    """Shorten the source's offset before where the clouds lie too far apart to be seen in one picture.

    Args:
        local: source and target, each relative to its centre.
        offset: from the target's centre to the source's.

    Returns:
        The offset to draw, and the distance it stands for, 0 where it is drawn as it is.
    """
    reach = sum(frame(points)["radius"] for points in local)
    gap = float(np.linalg.norm(offset))
    if gap <= 3 * reach:
        return offset, 0.0
    return offset * (1.2 * reach / gap), gap


def frame(*clouds: Points) -> dict[str, Any]:
    """Centre and radius of the sphere to look at; a few stray points are left outside."""
    ranges = np.stack([np.percentile(points, [1, 99], axis=0) for points in clouds])
    centre = (ranges[:, 0].min(axis=0) + ranges[:, 1].max(axis=0)) / 2
    radius = max(float(np.percentile(np.linalg.norm(points - centre, axis=1), 99)) for points in clouds)
    return {"centre": centre.tolist(), "radius": radius or 1.0}


def guess_up(points: Points) -> str:
    """The axis that probably points up: ``+y``, ``+z`` or ``-y``."""
    low, high = np.percentile(points, [1, 99], axis=0)
    width, depth, height = high - low
    if height < 0.35 * min(width, depth):
        return "+z"  # flat: ground seen by a laser scanner
    if low[2] > 0 and max(np.abs([low[:2], high[:2]]).max(axis=0)) < high[2]:
        return "-y"  # in front of the origin: a depth camera's frame
    return "+y"
