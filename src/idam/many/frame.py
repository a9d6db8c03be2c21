"""The coordinates that poses are worked out in: about each scan's centre, and in units of a scan's radius."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from idam import rigid
from idam.many.scans import Scan
from idam.rigid import Array

__all__ = ["Frame"]


@dataclass(frozen=True)
class Frame:
    """Each scan about its own centre, all in one unit.

    Near the origin no digit is lost, and a radian moves a scan's points about as far as a unit does.

    Attributes:
        centres: (N, 3) of the scans, in input units.
        unit: input units in a working unit: the median radius of the scans.
    """

    centres: Array
    unit: float

    @classmethod
    def of(cls, scans: Sequence[Scan]) -> Frame:
        """The frame of some scans."""
        centres = np.stack([scan.prepared.centre for scan in scans])
        return cls(centres, float(np.median([scan.prepared.radius for scan in scans])))

    def enter(self, source: int, target: int, transformation: Array) -> Array:
        """A transform (4, 4) from a source to a target, in working coordinates."""
        rotation = transformation[:3, :3]
        shift = transformation[:3, 3] + rotation @ self.centres[source] - self.centres[target]
        return rigid.transform(rotation, shift / self.unit)

    def placed(self, scans: Sequence[int], poses: Array) -> Array:
        """Poses (M, 4, 4) from some scans' own frames to one that they share, in working coordinates."""
        rotation = poses[:, :3, :3]
        shift = poses[:, :3, 3] + (rotation @ self.centres[list(scans), :, None])[..., 0]
        return rigid.transform(rotation, (shift - shift[0]) / self.unit)

    def covariance(self, source: int, information: Array) -> Array:
        """The covariance (6, 6) of a transform from a source, of its information in input units.

        With x = Ad(C) D y, where C moves the source's centre to the origin's place and D scales lengths. A direction
        that nothing holds gets a standard deviation of one.
        """
        there = rigid.adjoint(rigid.transform(np.eye(3), self.centres[source])) * np.repeat([1.0, self.unit], 3)
        return np.asarray(np.linalg.inv(there.T @ information @ there + np.eye(6)))

    def leave(self, poses: Array, components: Sequence[Sequence[int]]) -> Array:
        """Working poses (N, 4, 4) in input units, from each scan's own frame to that of its component's first scan."""
        final = np.tile(np.eye(4), (len(poses), 1, 1))
        for scans in components:
            first = scans[0]
            for scan in scans:
                if scan != first:  # whose own pose is the identity, to the last bit
                    relative = rigid.inverse(poses[first]) @ poses[scan]
                    rotation = rigid.nearest_rotation(relative[:3, :3])
                    shift = self.unit * relative[:3, 3] + self.centres[first] - rotation @ self.centres[scan]
                    final[scan] = rigid.transform(rotation, shift)
        return final
