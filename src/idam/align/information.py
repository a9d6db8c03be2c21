"""How precisely a transform is known: its information matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam.align.patches import Pairs
from idam.rigid import Array

__all__ = ["information"]

FEWEST = 12
"""Pairs below which nothing can be told."""
BLOCK = 8.0
"""Side of the blocks within which residuals may be alike, in spacings."""


def information(pairs: Pairs, spacing: float) -> Array:
    """The information matrix (6, 6) of a transform: the inverse of its covariance, in working units.

    Of T exp(x), rotation before translation. Residuals are not independent: neighbouring patches share points and
    normals, and a scanner errs alike over some distance. So the scatter is taken from sums over blocks of space
    (a cluster-robust, "sandwich" covariance, Liang and Zeger 1986), of which one number is kept, by how much it exceeds
    what independent residuals would have: few blocks do not tell it direction by direction.
    What holds a direction is the product of both clouds' normals, whose noise is independent: the square of one alone
    would find information where a surface slides along itself.

    Zero where too little lies on each other to tell; elsewhere positive definite, with 1 added for a pose that is known
    to about the size of the clouds in any case.
    """
    if len(pairs.points) < FEWEST:
        return np.zeros((6, 6))
    weights = pairs.weights[:, None]
    gradient = pairs.gradients(pairs.normals)
    fixed = gradient.T @ (weights * gradient) * pairs.slope + 1e-9 * len(gradient) * np.eye(6)
    scores = _sums(gradient * weights * pairs.residuals[:, None], _blocks(pairs.points, BLOCK * spacing))
    variance = float(np.einsum("bi,ij,bj->", scores, np.linalg.inv(fixed), scores)) / 6
    variance *= len(scores) / max(len(scores) - 6, 1)  # the six that were fitted leave the sums so much too small
    held = pairs.gradients(pairs.source_normals).T @ (weights * pairs.gradients(pairs.target_normals)) * pairs.slope
    values, axes = np.linalg.eigh((held + held.T) / (2 * max(variance, 1e-18)))
    return np.asarray((axes * (values.clip(0) + 1)) @ axes.T)


def _blocks(points: Array, size: float) -> NDArray[np.int64]:
    """The number of the cube of space that each point (C, 3) lies in, (C,)."""
    cells = np.floor(points / size).astype(np.int64)
    return np.asarray(np.unique(cells @ np.array([1, 2**20, 2**40]), return_inverse=True)[1]).ravel()


def _sums(rows: Array, block: NDArray[np.int64]) -> Array:
    """The sum of the rows (C, K) in each block (B, K)."""
    return np.stack([np.bincount(block, column) for column in rows.T], 1)
