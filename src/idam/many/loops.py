"""Loops of three links: what a graph knows of a link beyond the link itself."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.many.graph import EVEN_ODDS, Links
from idam.rigid import Array, Rows

__all__ = ["Loops", "find_loops"]


@dataclass(frozen=True)
class Loops:
    """M loops of three links.

    Attributes:
        links: (M, 3) rows of links.
        error: (M, 6) the twist that is left when one has gone around, at the first scan of the first link.
        closes: (M,) whether that is what the three links' information allows for.
    """

    links: Rows
    error: Array
    closes: NDArray[np.bool_]

    def closed(self, count: int) -> Rows:
        """How many loops of each of so many links close, (L,)."""
        return np.bincount(self.links[self.closes].ravel(), minlength=count)


def find_loops(count: int, links: Links) -> Loops:
    """All loops of three links among ``count`` scans, each once."""
    row = {
        tuple(sorted(ends)): i for i, ends in enumerate(zip(links.source.tolist(), links.target.tolist(), strict=True))
    }
    near: list[list[int]] = [[] for _ in range(count)]
    for one, other in row:
        near[one].append(other)
    corners = [(a, b, c) for a in range(count) for b, c in combinations(sorted(near[a]), 2) if (b, c) in row]
    triples = np.array([[row[a, b], row[b, c], row[a, c]] for a, b, c in corners], np.int64).reshape(-1, 3)
    a, b, c = np.array(corners, np.int64).reshape(-1, 3).T
    covariance = np.asarray(np.linalg.inv(links.information), np.float64)
    around = np.tile(np.eye(4), (len(triples), 1, 1))
    spread = np.zeros((len(triples), 6, 6))
    for rows, start in zip(triples.T, (b, c, a), strict=True):  # T_a_b, then T_b_c, then T_c_a
        step, uncertainty = _read_from(links, covariance, rows, start)
        back = rigid.adjoint(rigid.inverse(step))
        spread = back @ spread @ back.swapaxes(-1, -2) + uncertainty
        around = around @ step
    error = rigid.log(around)
    misfit = np.einsum("mi,mi->m", error, np.linalg.solve(spread, error[..., None])[..., 0])
    return Loops(triples, error, misfit < EVEN_ODDS)


def _read_from(links: Links, covariance: Array, rows: Rows, start: Rows) -> tuple[Array, Array]:
    """Links' transforms from the scans ``start`` to their other ends, and their covariances in the scans' frames.

    The inverse of Z exp(x) is ``exp(-x) Z^-1 = Z^-1 exp(-Ad(Z) x)``.
    """
    forward = (links.source[rows] == start)[:, None, None]
    measured, own = links.measured[rows], covariance[rows]
    there = rigid.adjoint(measured)
    turned = there @ own @ there.swapaxes(-1, -2)
    return np.where(forward, measured, rigid.inverse(measured)), np.where(forward, own, turned)
