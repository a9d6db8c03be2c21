"""How precisely a transform is known: its information matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam.align.patches import Pairs
from idam.rigid import Array

__all__ = ["inflation", "information"]

FEWEST = 12
"""Pairs below which nothing can be told."""
BLOCK = 0.3
"""Side of the blocks within which residuals may be alike, in working units (about the radius of the larger cloud).

What a scanner bends goes over a good part of an object. Of 0.1, 0.2, 0.3, 0.4 and 0.5 the loops of three bunny scans
have a mean squared error of 12.6, 6.0, 5.1, 3.9 and 3.2 by the covariances, where 6 is right. Synthetic scans, whose
noise is independent, hardly tell them apart from 0.2 on (3.8 to 10.5 at 0.3)."""


def information(pairs: Pairs) -> Array:
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
    variance = inflation(pairs, gradient, pairs.residuals, fixed)
    held = pairs.gradients(pairs.source_normals).T @ (weights * pairs.gradients(pairs.target_normals)) * pairs.slope
    values, axes = np.linalg.eigh((held + held.T) / (2 * variance))
    return np.asarray((axes * (values.clip(0) + 1)) @ axes.T)


def inflation(pairs: Pairs, gradient: Array, residuals: Array, fixed: Array) -> float:
    """The variance of a residual as if they were independent: the scatter of sums over blocks, per unknown.

    Args:
        pairs: whose residuals they are.
        gradient: of the residuals by the K unknowns, (C, K).
        residuals: (C,), under the fit.
        fixed: how fast the sum of what pulls falls with the unknowns, (K, K).
    """
    pull = _sums(gradient * (pairs.weights * residuals)[:, None], _blocks(pairs.points, BLOCK))
    blocks, unknowns = pull.shape
    scatter = float(np.einsum("bi,ij,bj->", pull, np.linalg.inv(fixed), pull)) / unknowns
    # the unknowns that were fitted leave the sums so much too small
    return float(max(scatter * blocks / max(blocks - unknowns, 1), 1e-18))


def _blocks(points: Array, size: float) -> NDArray[np.int64]:
    """The number of the cube of space that each point (C, 3) lies in, (C,)."""
    cells = np.floor(points / size).astype(np.int64)
    return np.asarray(np.unique(cells @ np.array([1, 2**20, 2**40]), return_inverse=True)[1]).ravel()


def _sums(rows: Array, block: NDArray[np.int64]) -> Array:
    """The sum of the rows (C, K) in each block (B, K)."""
    return np.stack([np.bincount(block, column) for column in rows.T], 1)
