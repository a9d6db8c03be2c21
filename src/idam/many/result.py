"""What merging many scans returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from idam.io import PointCloud
from idam.many.cloud import fuse
from idam.rigid import Array

__all__ = ["Link", "MergeResult"]


@dataclass(frozen=True, eq=False)
class Link:
    """A registered pair of scans.

    Attributes:
        source: number of a scan.
        target: number of a scan.
        transformation: (4, 4), source coordinates to target coordinates, as registered.
        information: (6, 6) of the transformation, as :attr:`idam.RegistrationResult.information`.
        confidence: probability that the registration alone gave the transformation to be right.
        overlap: share of the source's points that it puts on the target.
        residual: root mean square distance of those points from the target, in the input's units.
        used: whether the poses follow it.
        reason: why not, if it is not used.
        loop_error: what the loops of three links through it fail to close by, in degrees and in the input's units:
            of the one that closes best, since a wrong link closes none. None where there is no loop.
    """

    source: int
    target: int
    transformation: Array = field(repr=False)
    information: Array = field(repr=False)
    confidence: float
    overlap: float
    residual: float
    used: bool = False
    reason: str = ""
    loop_error: tuple[float, float] | None = None

    def numbered(self, number: Sequence[int]) -> Link:
        """The same between the scans of these numbers."""
        return replace(self, source=number[self.source], target=number[self.target])


@dataclass(frozen=True, eq=False)
class MergeResult:
    """Poses of many scans, and how sure they are.

    Attributes:
        names: of the N scans, in the order given.
        poses: N transforms (4, 4) float64 from a scan's frame to that of the first scan of its component, or None for
            a scan that has no trustworthy link to any other.
        components: numbers of the scans that hang together, the largest set first; in each the scan whose frame it has
            comes first. A scan alone is a component; one that could not be read is in none.
        confidence: (N,) probability that a scan's pose is right relative to its component, 0 without a pose.
        reason: N words on what is doubtful about a scan, empty where nothing is.
        links: all registered pairs.
        spacing: distance of neighbouring points of the scans, as far as 100,000 points of each show it, in the input's
            units.
        seconds: wall-clock time it took.
    """

    names: list[str]
    poses: list[Array | None]
    components: list[list[int]]
    confidence: Array
    reason: list[str]
    links: list[Link] = field(repr=False)
    spacing: float
    seconds: float
    clouds: Sequence[PointCloud | None] = field(repr=False)

    @property
    def complete(self) -> bool:
        """Whether every scan has its place in one frame, and none of them hangs on one link."""
        return len(self.components) == 1 and len(self.components[0]) == len(self.names) and not any(self.reason)

    def component_of(self, scan: int) -> int:
        """The number of the component that a scan is in; -1 for one that could not be read."""
        return next((number for number, scans in enumerate(self.components) if scan in scans), -1)

    def merged(self, voxel_size: float | None = None) -> PointCloud:
        """The scans of the largest component as one cloud in its frame, each place once.

        Args:
            voxel_size: of the grid that thins them, in the input's units; None for the spacing of the scans.

        Returns:
            The mean of the points in each voxel, with colours and normals where all of the scans have them, and the
            number of the scan that it is from as the attribute ``scan``.

        Raises:
            InputError: no scan is placed, or the voxel size is out of range.
        """
        scans = [scan for scan in self.components[0] if self.poses[scan] is not None]
        placed = [(self.clouds[scan], self.poses[scan]) for scan in scans]
        moved = [cloud.transformed(pose) for cloud, pose in placed if cloud is not None and pose is not None]
        return fuse(moved, self.spacing if voxel_size is None else voxel_size, scans)
