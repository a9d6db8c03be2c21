"""Sparse normal equations of a pose graph, solved by eliminating scan after scan."""

from __future__ import annotations

import numpy as np

from idam.rigid import Array, Rows

__all__ = ["Elimination"]


class Elimination:
    """Which scan to eliminate when, and what that fills in: found once for a graph, used for each solution.

    Block Cholesky with 6x6 blocks and the order of least degree, in NumPy. The matrix of a graph in which scans link to
    some neighbours stays sparse: time grows little faster than the number of scans.

    Args:
        count: number of scans, N.
        source: (L,) rows of the scans at one end of each link.
        target: (L,) at the other.
    """

    def __init__(self, count: int, source: Rows, target: Rows):
        neighbours: list[set[int]] = [set() for _ in range(count)]
        for one, other in zip(source.tolist(), target.tolist(), strict=True):
            neighbours[one].add(other)
            neighbours[other].add(one)
        slots: dict[tuple[int, int], int] = {}

        def slot(row: int, column: int) -> int:
            return slots.setdefault((row, column), len(slots))

        self._links = [slot(one, other) for one, other in zip(source.tolist(), target.tolist(), strict=True)]
        self._back = [slot(other, one) for one, other in zip(source.tolist(), target.tolist(), strict=True)]
        self._diagonal = [slot(scan, scan) for scan in range(count)]
        self._steps: list[tuple[int, Rows, Rows, Rows]] = []
        remaining = set(range(count))
        while remaining:
            scan = min(remaining, key=lambda other: (len(neighbours[other]), other))
            remaining.remove(scan)
            near = sorted(neighbours[scan])
            column = np.array([slot(other, scan) for other in near], np.int64)
            square = np.array([[slot(row, other) for other in near] for row in near], np.int64)
            self._steps.append((scan, np.array(near, np.int64), column, square.reshape(len(near), len(near))))
            for other in near:
                neighbours[other] |= neighbours[scan]
                neighbours[other] -= {other, scan}
        self._count = len(slots)

    def solve(self, diagonal: Array, across: Array, right: Array, damping: float) -> Array:
        """The solution (N, 6) of the damped equations.

        Args:
            diagonal: (N, 6, 6) blocks.
            across: (L, 6, 6) blocks of source by target; those of one pair add up.
            right: (N, 6).
            damping: share of its own diagonal that is added to each block of it.
        """
        blocks, right = np.zeros((self._count, 6, 6)), right.copy()
        blocks[self._diagonal] = diagonal
        np.add.at(blocks, self._links, across)
        np.add.at(blocks, self._back, across.swapaxes(-1, -2))
        own = np.diagonal(diagonal, axis1=-2, axis2=-1)
        floor = max(1e-12 * float(own.max(initial=0.0)), 1e-300)  # of a scan that no link holds
        scans, axes = np.array(self._diagonal)[:, None], np.arange(6)
        blocks[scans, axes, axes] += damping * own + floor
        solved = []
        for scan, near, column, square in self._steps:
            below = blocks[column].reshape(-1, 6)
            share = np.linalg.solve(blocks[self._diagonal[scan]], np.column_stack([below.T, right[scan]]))
            solved.append(share)
            if len(near):
                shape = (len(near), 6, len(near), 6)
                blocks[square] -= (below @ share[:, :-1]).reshape(shape).swapaxes(1, 2)
                right[near] -= (below @ share[:, -1]).reshape(-1, 6)
        answer = np.zeros((len(diagonal), 6))
        for (scan, near, _, _), share in zip(reversed(self._steps), reversed(solved), strict=True):
            answer[scan] = share[:, -1] - share[:, :-1] @ answer[near].ravel()
        return answer
