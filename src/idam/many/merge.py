"""``merge``: from many scans to one model, and which scans have no sure place in it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from idam.errors import InputError
from idam.io.files import StrPath
from idam.many import joint, starting
from idam.many.choice import Choice
from idam.many.frame import Frame
from idam.many.names import find
from idam.many.pairs import Kept, Pair, Row, Workers, register_pairs
from idam.many.partners import likeliness
from idam.many.posed import Posed, pose
from idam.many.result import MergeResult
from idam.many.scans import Scan, described, read_scans, spacing, thinned
from idam.many.starting import StartingPoses
from idam.registration import check_options
from idam.rigid import Array

__all__ = ["THRESHOLD", "merge"]

THRESHOLD = 0.9
"""Probability from which a place counts as sure."""

Progress = Callable[[str, int, int], None]


def merge(
    scans: Iterable[Any],
    *,
    reference: str | int | None = None,
    voxel_size: float | None = None,
    partners: int | None = None,
    jobs: int = 1,
    threshold: float = THRESHOLD,
    poses: Mapping[str, ArrayLike] | None = None,
    strict: bool = False,
    keep: StrPath | None = None,
    progress: Progress = lambda *_: None,
) -> MergeResult:
    """Find the poses of many scans, as far as they can be trusted.

    Pairs of scans are registered; a robust pose graph finds which of the registrations agree; scans without a
    trustworthy link between them are left in components with frames of their own; and all overlapping scans of a
    component are refined together.

    Args:
        scans: paths, folders, arrays (N, 3), clouds, or what :func:`idam.prepare` returned: at least two, in one unit,
            in any order and any pose.
        reference: name or number of the scan whose frame its component has; None for the first scan of each component.
        voxel_size: as :func:`idam.register` takes it, for every pair.
        partners: how many likely partners of each scan are registered with it at first, and how many links each scan
            should come to have. None for all of up to 30 scans, and 4 of more.
        jobs: processes that register pairs. With more than one, a script must start its work under
            ``if __name__ == "__main__":``, as Python's ``multiprocessing`` asks.
        threshold: probability from which a place counts as sure.
        poses: starting poses (4, 4) by scan name, all to one frame; None for those that E57 and PTX files bring. Scans
            that they put on each other are registered first, with the pose as one hypothesis among others.
        strict: whether a scan that cannot be read is an error, rather than left out.
        keep: a file that registered pairs are kept in and found again in, after a run that was stopped.
        progress: called with what is being done, and how many of how many are done.

    Returns:
        The poses, which scans hang together, and how sure each is.

    Raises:
        InputError: fewer than two scans can be used, two have one name, or an option is out of range.
    """
    started = time.perf_counter()
    check_options(180.0, voxel_size, None, "gicp", 0)
    check(partners, jobs, threshold)
    names, read = read_scans(scans, strict)
    some = [scan for scan in read if isinstance(scan, Scan)]
    first = None if reference is None else usable(find(reference, names), names, read)
    options = {} if voxel_size is None else {"voxel_size": voxel_size}
    frame = Frame.of(some)
    given = starting.given(poses, some)
    surfaces = thinned(some, frame.unit)
    start = StartingPoses.of(given, frame, surfaces)
    rows, kept = dict[Pair, Row](), Kept(keep)
    choice = Choice(len(some), partners, lambda: likeliness(*described(some)))
    posed = Posed.nothing(len(some))
    pairs = choice.first(start.overlaps) or choice.next(posed.unsure, posed.held, {}, range(len(some)))
    with Workers(some, jobs) as workers:
        while pairs:
            rows |= register_pairs(some, pairs, options, start.guesses, kept, workers, progress)
            progress("pose graph", 0, 1)
            posed = pose(some, frame, rows, threshold, first)
            unsure = sorted({*posed.unsure, *start.contradicted(posed)})
            overlaps = joint.all_overlaps(posed.poses, surfaces, posed.trust.components)
            pairs = choice.next(unsure, posed.held, overlaps, posed.component)
    progress("joint refinement", 0, 1)
    refined = joint.refine(posed.poses, surfaces, posed.trust.components)
    if posed.contradicts(refined):
        refined = posed.poses
    return collect(names, read, posed, frame.leave(refined, posed.trust.components), spacing(some), started)


def collect(
    names: list[str], read: list[Scan | str], posed: Posed, poses: Array, apart: float, started: float
) -> MergeResult:
    """The result for all scans given, from that for those that could be read."""
    number = [i for i, scan in enumerate(read) if isinstance(scan, Scan)]
    confidence = np.zeros(len(names))
    confidence[number] = posed.trust.confidence
    placed = {scan for scans in posed.trust.components if len(scans) > 1 for scan in scans}
    reason = [scan if isinstance(scan, str) else "" for scan in read]
    final: list[Array | None] = [None] * len(names)
    for scan, row in enumerate(number):
        reason[row] = posed.trust.reason[scan]
        if scan in placed:
            final[row] = poses[scan]
    return MergeResult(
        names=names,
        poses=final,
        components=[[number[scan] for scan in scans] for scans in posed.trust.components],
        confidence=confidence,
        reason=reason,
        links=[link.numbered(number) for link in posed.links],
        spacing=apart,
        seconds=time.perf_counter() - started,
        clouds=[scan.cloud if isinstance(scan, Scan) else None for scan in read],
    )


def usable(number: int, names: list[str], read: list[Scan | str]) -> int:
    """The place of a scan among those that can be used."""
    if isinstance(read[number], str):
        raise InputError(f"the reference {names[number]} cannot be used ({read[number]}): name another scan")
    return sum(isinstance(scan, Scan) for scan in read[:number])


def check(partners: int | None, jobs: int, threshold: float) -> None:
    """Raise InputError for options out of range."""
    for name, value in (("partners", 1 if partners is None else partners), ("jobs", jobs)):
        if not (isinstance(value, Integral) and value > 0):
            raise InputError(f"{name} must be a whole number above 0, not {value!r}")
    if not (isinstance(threshold, Real) and 0.5 <= threshold < 1):
        raise InputError(f"threshold must be a probability of at least 0.5 and below 1, not {threshold!r}")
