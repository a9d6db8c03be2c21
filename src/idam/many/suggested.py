"""Starting poses of scans: which pairs they put on each other, and whether what was found bears them out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.many.frame import Frame
from idam.many.joint import overlaps
from idam.many.pairs import Pair
from idam.many.posed import Posed
from idam.many.scans import Thinned
from idam.many.trust import far
from idam.rigid import Array

__all__ = ["Suggested"]


@dataclass(frozen=True)
class Suggested:
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
    def of(cls, given: Mapping[int, Array], frame: Frame, surfaces: Sequence[Thinned]) -> Suggested:
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
            suggested = rigid.inverse(self.poses[other]) @ self.poses[one]
            actual = rigid.inverse(found.poses[other]) @ found.poses[one]
            if far(rigid.log(rigid.inverse(suggested) @ actual)):
                scans |= {one, other}
        return sorted(scans)
