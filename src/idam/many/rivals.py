"""Other explanations of a graph: what look-alike places make of it.

Where two rooms are alike, many links that agree say that they are one, and but few, along the corridor between them,
say otherwise. As links go the many win; yet they are one mistake made many times. So for a link that contradicts the
poses the best explanation in which it is right is looked for. If that is about as likely, once links that join the same
two places count as one, only what holds in both explanations is certain.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from idam.many.elimination import Elimination
from idam.many.graph import Links, along, barriers, misfit, settled, spanning_forest
from idam.many.trust import far_off, log_odds, near_each_other, places_apart
from idam.rigid import Array, Rows

__all__ = ["certain"]

CONTRADICTIONS = 5
"""The surest links that contradict the poses, which other explanations are looked for."""


def certain(
    poses: Array, links: Links, agrees: NDArray[np.bool_], support: Rows, threshold: float
) -> NDArray[np.bool_]:
    """Which links (L,) agree with the poses and with every explanation that is about as likely.

    Args:
        poses: (N, 4, 4), lengths in radii of a scan.
        links: all links.
        agrees: (L,) whether each agrees with the poses.
        support: (L,) how many loops of each link close.
        threshold: probability from which the poses count as the only explanation.
    """
    held: NDArray[np.bool_] = agrees.copy()
    against = np.flatnonzero(~agrees & far_off(poses, links) & (links.confidence > 0.5))
    for row in against[np.argsort(-links.confidence[against], kind="stable")][:CONTRADICTIONS].tolist():
        rival = explained(len(poses), links, agrees, row, support)
        common = near_each_other(len(poses), links, np.flatnonzero(agrees & rival))
        lost, won = np.flatnonzero(agrees & ~rival), np.flatnonzero(rival & ~agrees)
        if not rival[row]:
            continue
        ahead = evidence(links, lost, common, links.confidence) - evidence(links, won, common, links.confidence)
        if ahead < math.log(threshold / (1 - threshold)):
            held &= rival
    return held


def explained(count: int, links: Links, agrees: NDArray[np.bool_], row: int, support: Rows) -> NDArray[np.bool_]:
    """Which links (L,) agree with the poses that follow from one (row) and, of those that agree, the least supported.

    Links between look-alike places close many loops, those of the only way from one to the other few.
    """
    barrier = barriers(links.confidence)
    usable = np.flatnonzero(agrees | (np.arange(len(links)) == row))
    some = links[usable]
    order = some.confidence - np.rint(np.log2(1 + support[usable]))
    order[usable == row] = np.inf
    poses = along(count, some, spanning_forest(count, some, order))
    poses = settled(poses, some, barrier[usable], Elimination(count, some.source, some.target))
    return np.asarray(misfit(poses, links) < barrier)


def evidence(links: Links, rows: Rows, near: NDArray[np.bool_], confidence: Array) -> float:
    """Log odds that links (rows) are right, those that join the same two places counted once."""
    if not len(rows):
        return 0.0
    rows = rows[np.argsort(-confidence[rows], kind="stable")]
    return log_odds(confidence[rows[places_apart(links.source[rows], links.target[rows], near)]])
