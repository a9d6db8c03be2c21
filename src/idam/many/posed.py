"""From registered pairs to poses: which links agree, which scans hang together, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import TOUCHING
from idam.many.frame import Frame
from idam.many.graph import Links, barriers, misfit, optimise
from idam.many.loops import Loops, find_loops
from idam.many.pairs import Pair, Row
from idam.many.result import Link
from idam.many.scans import Scan
from idam.many.trust import Trust, far_off, weigh
from idam.rigid import Array

__all__ = ["Posed", "pose"]

PRECISION = 1 / 3
"""Spacings of the points that a right registration of real scans is off by at least, one standard deviation, whatever
its information says: on the bunny's scans right ones are off by 0.2 to 0.8."""


@dataclass(frozen=True, eq=False)
class Posed:
    """Poses of N scans.

    Attributes:
        poses: (N, 4, 4), working coordinates to those that a component shares.
        trust: which scans hang together.
        links: all registered pairs, as the result has them.
        used: the links that the poses follow, in working coordinates.
    """

    poses: Array
    trust: Trust
    links: list[Link]
    used: Links

    @classmethod
    def nothing(cls, count: int) -> Posed:
        """Of so many scans, before any is registered."""
        none = np.zeros(0, np.int64)
        links = Links(none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros(0))
        alone = Trust([[scan] for scan in range(count)], np.zeros(count), [""] * count)
        return cls(np.tile(np.eye(4), (count, 1, 1)), alone, [], links)

    @property
    def held(self) -> list[int]:
        """How many links hold each scan."""
        ends = np.concatenate([self.used.source, self.used.target])
        return [int(number) for number in np.bincount(ends, minlength=len(self.poses))]

    @property
    def component(self) -> list[int]:
        """The number of the component that each scan is in."""
        numbers = {scan: number for number, scans in enumerate(self.trust.components) for scan in scans}
        return [numbers[scan] for scan in range(len(self.poses))]

    @property
    def unsure(self) -> list[int]:
        """Scans that have no place in the largest component, or a doubtful one."""
        placed = set(self.trust.components[0]) if len(self.trust.components[0]) > 1 else set()
        return [scan for scan, reason in enumerate(self.trust.reason) if reason or scan not in placed]

    def contradicts(self, poses: Array) -> bool:
        """Whether other poses (N, 4, 4) make a link wrong that these follow."""
        return bool(far_off(poses, self.used).any())


def pose(scans: Sequence[Scan], frame: Frame, rows: Mapping[Pair, Row], threshold: float, first: int | None) -> Posed:
    """Poses of scans that agree with the registered pairs.

    Args:
        scans: all of them.
        frame: theirs.
        rows: what was registered, by source and target.
        threshold: probability from which a place counts as sure.
        first: the scan whose frame its component has; None for the first of each.
    """
    pairs = sorted(pair for pair, row in rows.items() if not row["error"])
    links = working_links(frame, pairs, rows)
    loops = find_loops(len(scans), links)
    poses, agrees = optimise(len(scans), links, loops.closed(len(links)))
    names = [scan.name for scan in scans]
    trust = weigh(poses, links, agrees, names, threshold, first)
    component = {scan: number for number, members in enumerate(trust.components) for scan in members}
    inside = np.array([component[one] == component[other] for one, other in pairs], bool).reshape(len(pairs))
    used = agrees & inside
    reasons = why_not(poses, links, agrees, inside, frame.unit)
    closing = closest(loops, len(links), frame.unit)
    final = [
        Link(
            source=pair[0],
            target=pair[1],
            transformation=np.array(rows[pair]["transformation"]),
            information=np.array(rows[pair]["information"]),
            confidence=rows[pair]["confidence"],
            overlap=rows[pair]["overlap"],
            residual=rows[pair]["residual"],
            used=bool(used[i]),
            reason=reasons[i],
            loop_error=closing.get(i),
        )
        for i, pair in enumerate(pairs)
    ]
    return Posed(poses, with_errors(trust, rows), final, links[np.flatnonzero(used)])


def working_links(frame: Frame, pairs: list[Pair], rows: Mapping[Pair, Row]) -> Links:
    """The links in working coordinates, none of them more precise than the points allow.

    A registration that measured too little to have an information has none of its own to weigh, nor a right answer: its
    confidence counts as zero.
    """
    count = len(pairs)
    measured, covariance, confidence = np.zeros((count, 4, 4)), np.zeros((count, 6, 6)), np.zeros(count)
    for i, pair in enumerate(pairs):
        row = rows[pair]
        own = np.array(row["information"])
        measured[i] = frame.enter(*pair, np.array(row["transformation"]))
        spacing = row["reach"] / TOUCHING / frame.unit
        covariance[i] = frame.covariance(pair[0], own) + (PRECISION * spacing) ** 2 * np.eye(6)
        confidence[i] = row["confidence"] if own.any() else 0.0
    ends = np.array(pairs, np.int64).reshape(count, 2)
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return Links(ends[:, 0], ends[:, 1], measured, information, confidence)


def why_not(poses: Array, links: Links, agrees: NDArray[np.bool_], inside: NDArray[np.bool_], unit: float) -> list[str]:
    """For each link why the poses do not follow it, empty where they do."""
    if not len(links):
        return []
    relative = rigid.inverse(poses[links.target]) @ poses[links.source]
    off = rigid.inverse(links.measured) @ relative
    degrees = np.degrees(rigid.angle(off))
    shift = unit * np.linalg.norm(off[:, :3, 3], axis=1)
    believed = barriers(links.confidence) > 0
    sigmas = np.sqrt(misfit(poses, links))
    reasons = []
    for i in range(len(links)):
        if agrees[i]:
            reasons.append("" if inside[i] else "not sure enough to join two components")
        elif not believed[i]:
            reasons.append("too unsure to be believed")
        else:
            reasons.append(f"off by {degrees[i]:.3g} degrees and {shift[i]:.3g} ({sigmas[i]:.3g} standard deviations)")
    return reasons


def closest(loops: Loops, count: int, unit: float) -> dict[int, tuple[float, float]]:
    """By link the error of the loop through it that closes best, in degrees and input units."""
    degrees = np.degrees(np.linalg.norm(loops.error[:, :3], axis=1))
    shift = np.linalg.norm(loops.error[:, 3:], axis=1)
    size = np.hypot(np.radians(degrees), shift)
    best: dict[int, tuple[float, float]] = {}
    for loop in np.argsort(size, kind="stable").tolist():
        for link in loops.links[loop].tolist():
            best.setdefault(link, (float(degrees[loop]), float(unit * shift[loop])))
    return best


def with_errors(trust: Trust, rows: Mapping[Pair, Row]) -> Trust:
    """The trust, with what went wrong for scans that could not be registered with any other."""
    for scan, reason in enumerate(trust.reason):
        if reason.startswith("no link"):
            errors = [row["error"] for pair, row in sorted(rows.items()) if scan in pair and row["error"]]
            trust.reason[scan] = f"{reason} ({errors[0]})" if errors else reason
    return trust
