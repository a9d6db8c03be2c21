"""Joint refinement: all overlapping pairs of scans at once, so that what is left over a loop is spread along it.

Each step linearises generalised ICP (Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009) of every overlapping pair at
the present poses. For a perturbation x of T_t_s from the right, small_gicp gives the cost ``x^T H x / 2 + b^T x``;
perturbing the poses by d_s and d_t makes ``x = d_s - Ad(X_s^-1 X_t) d_t``. The sum over all pairs is one sparse system,
as in the pose graph. Correspondences are sought anew in each step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from idam import rigid
from idam.many.elimination import Elimination
from idam.many.graph import straight
from idam.many.scans import Thinned
from idam.rigid import Array

__all__ = ["overlapping", "refine"]

REACH = 2.0
"""Spacings within which points pull on each other: the last refinement of a pair has it, too."""
LEAST = 0.1
"""Share of a scan's points on another from which the two count as overlapping."""
SAMPLE = 300
"""Points that tell the overlap."""
STEPS = 20
"""Steps at most."""
STILL = 0.01
"""Spacings that a scan moves in a step at most once all are still."""
DAMPING = 1e-6
"""Share of its own information that holds a scan."""


def overlapping(poses: Array, surfaces: Sequence[Thinned], scans: Sequence[int]) -> list[tuple[int, int]]:
    """The pairs among some scans, source and target, of which enough lies on each other under the poses."""
    reach = {scan: float(np.linalg.norm(surfaces[scan].points, axis=1).max()) for scan in scans}
    pairs = []
    for i, target in enumerate(scans):
        for source in scans[i + 1 :]:
            apart = np.linalg.norm(poses[source, :3, 3] - poses[target, :3, 3])
            if apart < reach[source] + reach[target] and overlap(poses, surfaces, source, target) >= LEAST:
                pairs.append((source, target))
    return pairs


def overlap(poses: Array, surfaces: Sequence[Thinned], source: int, target: int) -> float:
    """The share of the points of the scan with the larger share that lie on the other's."""
    shares = []
    for one, other in ((source, target), (target, source)):
        points = surfaces[one].points
        some = points[:: max(1, len(points) // SAMPLE)]
        moved = rigid.apply(rigid.inverse(poses[other]) @ poses[one], some)
        square = surfaces[other].surface.tree.batch_knn_search(moved, 1)[1][:, 0]
        near = REACH * max(surfaces[one].spacing, surfaces[other].spacing)
        shares.append(float((square < near**2).mean()))
    return max(shares)


def refine(
    poses: Array,
    surfaces: Sequence[Thinned],
    components: Sequence[Sequence[int]],
) -> Array:
    """Poses (N, 4, 4) of scans that are nearly right, improved within each component; its first scan stays.

    Args:
        poses: from coordinates relative to each scan's centre, in working units.
        surfaces: of the scans, N.
        components: numbers of the scans that share a frame.
    """
    pairs = [pair for scans in components for pair in overlapping(poses, surfaces, scans)]
    if not pairs:
        return poses
    source, target = np.array(pairs, np.int64).T
    elimination = Elimination(len(poses), source, target)
    reach = REACH * max(surfaces[scan].spacing for pair in pairs for scan in pair)
    for _ in range(STEPS):
        diagonal, right = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
        across = np.zeros((len(pairs), 6, 6))
        for row, (one, other) in enumerate(pairs):
            relative = rigid.inverse(poses[other]) @ poses[one]
            hessian, gradient = linearised(surfaces[one], surfaces[other], relative, reach)
            back = rigid.adjoint(rigid.inverse(relative))
            diagonal[one] += hessian
            diagonal[other] += back.T @ hessian @ back
            across[row] = -hessian @ back
            right[one] -= gradient
            right[other] += back.T @ gradient
        step = elimination.solve(diagonal, across, right, DAMPING)
        poses = straight(poses @ rigid.exp(step))
        if np.abs(step).max() < STILL * reach / REACH:
            break
    return poses


def linearised(source: Thinned, target: Thinned, relative: Array, reach: float) -> tuple[Array, Array]:
    """H (6, 6) and b (6,) of generalised ICP at T_target_source; zeros where nothing is near."""
    import small_gicp

    result = small_gicp.align(
        target.surface.cloud,
        source.surface.cloud,
        target.surface.tree,
        relative,
        registration_type="GICP",
        max_correspondence_distance=reach,
        num_threads=1,
        max_iterations=1,
    )
    return np.asarray(result.H), np.asarray(result.b)
