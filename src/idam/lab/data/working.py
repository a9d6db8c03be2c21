"""A pair of scans as :func:`idam.register` sees it: centred, thinned on one voxel grid, in working units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
from idam.clouds.surfaces import Surface
from idam.rigid import Array

__all__ = ["TOUCHING", "ScanPair", "as_registered"]

TOUCHING = 1.2
"""Spacings within which surfaces overlap."""


@dataclass(frozen=True)
class ScanPair:
    """Two scans in working coordinates, ready for features.

    Attributes:
        source: (N, 3).
        target: (P, 3).
        transformation: the truth (4, 4), source to target.
        spacing: of their points.
        overlap: share of the cloud that overlaps less.
    """

    source: Array
    target: Array
    transformation: Array
    spacing: float
    overlap: float


def as_registered(source: Array, target: Array, truth: Array, count: int) -> ScanPair:
    """Clouds (N, 3) and (P, 3), and the truth (4, 4), where about ``count`` points are left of the larger."""
    clouds = Pyramid(Prepared.of(source, "source"), Prepared.of(target, "target"))
    scans = clouds.with_points(count)
    truth = clouds.enter(truth)
    moved = rigid.apply(truth, scans.source)
    there, back = scans.surfaces.target.nearest(moved)[0], Surface.of(moved).nearest(scans.target)[0]
    shares = [np.mean(distance < TOUCHING * scans.spacing) for distance in (there, back)]
    return ScanPair(scans.source, scans.target, truth, scans.spacing, float(min(shares)))
