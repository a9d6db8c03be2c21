"""Starting poses: which pairs of scans they put on each other, and whether what was found bears them out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from idam import rigid
from idam.errors import InputError
from idam.io import rigid_fault
from idam.many.frame import Frame
from idam.many.joint import overlaps
from idam.many.pairs import Pair
from idam.many.posed import Posed
from idam.many.scans import Scan, Thinned
from idam.many.trust import far
from idam.registration import as_rigid
from idam.rigid import Array

__all__ = ["StartingPoses", "given"]


@dataclass(frozen=True)
class StartingPoses:
    """What starting poses say.

    Attributes:
        poses: (4, 4) by scan, working coordinates to those that they share.
        guesses: by pair that they put on each other, the transform (4, 4) in input units.
        overlaps: by such a pair, the share of the scans that lies on the other.
    """

    poses: dict[int, Array]
    guesses: dict[Pair, Array]
    overlaps: dict[Pair, float]

    @classmethod
    def of(cls, given: Mapping[int, Array], frame: Frame, surfaces: Sequence[Thinned]) -> StartingPoses:
        """From starting poses (4, 4) by scan, in input units."""
        if not given:
            return cls({}, {}, {})
        scans = sorted(given)
        poses = np.tile(np.eye(4), (len(surfaces), 1, 1))
        poses[scans] = frame.placed(scans, np.stack([given[scan] for scan in scans]))
        shares = overlaps(poses, surfaces, scans)
        guesses = {pair: rigid.inverse(given[pair[1]]) @ given[pair[0]] for pair in shares}
        return cls({scan: poses[scan] for scan in scans}, guesses, shares)

    def contradicted(self, found: Posed) -> list[int]:
        """Scans that were found elsewhere than their starting pose says, seen from any scan that it puts them on."""
        scans: set[int] = set()
        for one, other in self.overlaps:
            expected = rigid.inverse(self.poses[other]) @ self.poses[one]
            actual = rigid.inverse(found.poses[other]) @ found.poses[one]
            if far(rigid.log(rigid.inverse(expected) @ actual)):
                scans |= {one, other}
        return sorted(scans)


def given(poses: Mapping[str, ArrayLike] | None, scans: list[Scan]) -> dict[int, Array]:
    """The starting poses (4, 4), by the scans' places: those given, else those that the scans' files bring.

    Poses that are all equal say nothing: that is what files hold whose scans were never registered.
    """
    if poses is not None:
        places = {scan.name: place for place, scan in enumerate(scans)}
        if poses and not places.keys() & poses.keys():
            raise InputError(
                f"the starting poses are of none of the scans: of {', '.join(list(poses)[:3])}, where the scans are "
                f"{', '.join(list(places)[:3])}"
            )
        return {places[name]: as_rigid(matrix) for name, matrix in poses.items() if name in places}
    brought = {
        place: scan.pose for place, scan in enumerate(scans) if scan.pose is not None and not rigid_fault(scan.pose)
    }
    different = len({pose.tobytes() for pose in brought.values()}) > 1
    return {place: as_rigid(pose) for place, pose in brought.items()} if different else {}
