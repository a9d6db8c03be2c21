"""Matrix products with the same bits whatever the number of threads."""

from __future__ import annotations

import numpy as np

from idam.describe.neighbours import Array

__all__ = ["gram", "product"]

SMALL = 2**18
"""Multiplications up to which OpenBLAS takes one thread (its 65536 times GEMM_MULTITHREAD_THRESHOLD)."""
ROWS = 16
"""Rows of a block are a multiple of it, as of all kernels' tiles."""


def product(x: Array, y: Array, out: Array | None = None) -> Array:
    """The product x y (N, P) of float32 x (N, K) and y (K, P), in blocks too small for BLAS to use threads.

    With more threads a product is divided otherwise, and at the seams other kernels round otherwise: on some
    processors the last bit changes. Idle threads' busy waiting is spared as well.
    """
    if out is None:
        out = np.empty((len(x), y.shape[1]), x.dtype)
    columns = max(1, SMALL // (ROWS * x.shape[1]))
    for some in (slice(n, n + columns) for n in range(0, y.shape[1], columns)):
        _in_blocks_of_rows(x, y[:, some], out[:, some])
    return out


def gram(x: Array, y: Array) -> Array:
    """The product x^T y (K, P) of x (N, K) and y (N, P) with N far larger than K and P, likewise: a sum of blocks."""
    rows = max(1, SMALL // (x.shape[1] * y.shape[1]))
    total = np.zeros((x.shape[1], y.shape[1]), x.dtype)
    for some in (slice(n, n + rows) for n in range(0, len(x), rows)):
        total += x[some].T @ y[some]
    return total


def _in_blocks_of_rows(x: Array, y: Array, out: Array) -> None:
    rows = max(1, SMALL // (ROWS * y.size)) * ROWS
    whole = len(x) // rows * rows
    np.matmul(x[:whole].reshape(-1, rows, x.shape[1]), y, out=out[:whole].reshape(-1, rows, y.shape[1]))
    np.matmul(x[whole:], y, out=out[whole:])
