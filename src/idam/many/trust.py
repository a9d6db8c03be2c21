"""Which scans hang together, and how sure that is: a graph of poses never joins by force.

Links that agree with the poses speak for them, and links that do not speak against them. Both are weighed on the cuts
of the graph: any way to part the scans in two is a claim, "these lie right relative to those", and what is known of it
are the links across. The cuts that matter are those of a spanning tree of the surest links, one for each of its links:
where all links across a cut are weak, the tree crosses it just once.

**For a cut** speaks its surest link with the odds c / (1 - c) that it is right. Each further link across that agrees
multiplies them: it is right with probability c; had the first gone wrong, this one would have gone wrong the same way
with a probability of :data:`ALIKE`, as wrong answers do where places or objects are alike. So the odds grow by c /
:data:`ALIKE`, where that is more than one.

Confidences count for less than they say throughout, :func:`idam.many.graph.doubted`.

**Against it** speaks a link of more than even odds that contradicts the poses. Either it is wrong, or one of the cuts
on the way between its ends is: these are exclusive, each with its odds of being wrong. Look-alike places (two equal
rooms) yield many links that agree on the wrong thing, so here only links that join places of their own count for a
cut.

A cut that is right with less than the threshold is cut, and the sets of scans on its sides keep frames of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from idam.many.graph import Links, doubted, residuals, spanning_forest
from idam.rigid import Array, Rows

__all__ = ["ALIKE", "Trust", "far", "far_off", "weigh"]

ALIKE = 0.3
"""Probability that a link is wrong in the way that another one is: two of 0.8 that agree make one of 0.91."""
WRONG_ANGLE = math.radians(5)
WRONG_SHIFT = 0.1
"""What contradicts a pose: more than this off in rotation, or in radii of a scan. The confidence counts an answer as
right within 5 degrees and 0.05 radii; the rest is for what drifts along a chain."""


@dataclass(frozen=True)
class Trust:
    """What N scans' poses are worth.

    Attributes:
        components: the sets of scans that hang together, the largest first; of equal ones, the one with the first scan.
        confidence: (N,) probability that a scan lies right relative to its component's first scan; 0 for one alone.
        reason: N words on what is doubtful, empty where nothing is.
    """

    components: list[list[int]]
    confidence: Array
    reason: list[str]


@dataclass(frozen=True)
class Cut:
    """A way to part the scans in two, and what is known of it.

    Attributes:
        link: row of the tree's link across.
        side: (N,) the scans beyond it, seen from the tree's first scan.
        across: how many links that agree are across.
        probability: that the two sides lie right relative to each other.
        against: row of the link that speaks against it, if any does.
    """

    link: int
    side: NDArray[np.bool_]
    across: int
    probability: float
    against: int | None


def weigh(
    poses: Array,
    links: Links,
    agrees: NDArray[np.bool_],
    names: list[str],
    threshold: float,
    first: int | None = None,
) -> Trust:
    """Find the components, and how sure each scan is.

    Args:
        poses: (N, 4, 4), lengths in radii of a scan.
        links: all links.
        agrees: (L,) whether each agrees with the poses.
        names: of the scans, N.
        threshold: probability from which a cut counts as right.
        first: the scan that its component is measured from; None for the first of each.
    """
    count = len(poses)
    cuts = find_cuts(poses, replace(links, confidence=doubted(links.confidence)), agrees)
    holding = [cut for cut in cuts if cut.probability >= threshold]
    components = _components(count, links, [cut.link for cut in holding], first)
    confidence, reason = np.zeros(count), [""] * count
    for component in components:
        if len(component) == 1:
            reason[component[0]] = _why_alone(component[0], links, cuts, names)
            continue
        confidence[component] = 1.0
        for cut in holding:
            beyond = [scan for scan in component if cut.side[scan] != cut.side[component[0]]]
            confidence[beyond] *= cut.probability
            fewer = beyond if 2 * len(beyond) <= len(component) else sorted(set(component) - set(beyond))
            for scan in fewer if cut.across == 1 else []:
                reason[scan] = reason[scan] or f"hangs on one link, {_told(cut.link, links, names)}: nothing checks it"
    for component in components[1:]:
        for scan in component if len(component) > 1 else []:
            apart = f"apart from {names[components[0][0]]} and others: no trustworthy link leads there"
            reason[scan] = f"{apart}; {reason[scan]}" if reason[scan] else apart
    return Trust(components, confidence, reason)


def find_cuts(poses: Array, links: Links, agrees: NDArray[np.bool_]) -> list[Cut]:
    """The cuts of a spanning forest of the surest links that agree, one for each of its links."""
    used = np.flatnonzero(agrees)
    used = used[np.argsort(-links.confidence[used], kind="stable")]
    forest = used[spanning_forest(len(poses), links[used], links.confidence[used])].tolist()
    tree, sides = _sides(len(poses), links, forest)
    near = _near(len(poses), links, used)
    cautious, cuts = [], []
    for link, side in zip(forest, sides, strict=True):
        across = used[side[links.source[used]] != side[links.target[used]]]
        sure = links.confidence[across]
        own = np.where(side[links.source[across]], links.source[across], links.target[across])
        other = links.source[across] + links.target[across] - own
        cautious.append(_odds(sure[_apart(own, other, near)]))
        cuts.append(Cut(link, side, len(across), _logistic(_odds(sure)), None))
    for row, odds in _contradictions(poses, links, agrees, near):
        source, target = int(links.source[row]), int(links.target[row])
        if tree[source] != tree[target]:
            continue
        way = [i for i, side in enumerate(sides) if side[source] != side[target]]
        wrong = np.exp(-np.array([*(cautious[i] for i in way), odds]))
        for i, chance in zip(way, (wrong / wrong.sum()).tolist(), strict=False):
            if 1 - chance < cuts[i].probability:
                cuts[i] = replace(cuts[i], probability=1 - chance, against=row)
    return cuts


def _odds(sure: Array) -> float:
    """Log odds that links (K,) of these confidences, the surest first, that agree with each other are right."""
    return _logit(sure[0]) + float(np.log(np.maximum(sure[1:] / ALIKE, 1.0)).sum())


def _near(count: int, links: Links, used: Rows) -> NDArray[np.bool_]:
    """Which scans (N, N) see the same place: those with a link that agrees, and each itself."""
    near = np.eye(count, dtype=bool)
    near[links.source[used], links.target[used]] = near[links.target[used], links.source[used]] = True
    return near


def _apart(own: Rows, other: Rows, near: NDArray[np.bool_]) -> list[int]:
    """Which of the links across a cut join places of their own: no two of them near each other on both sides."""
    chosen: list[int] = []
    free = np.ones(len(own), bool)
    while free.any():
        place = int(np.argmax(free))
        chosen.append(place)
        free &= ~(near[own[place], own] & near[other[place], other])
    return chosen


def _contradictions(
    poses: Array, links: Links, agrees: NDArray[np.bool_], near: NDArray[np.bool_]
) -> list[tuple[int, float]]:
    """Links (rows) that the poses make wrong beyond doubt, with the log odds that they are right, where above even.

    Each scan that agrees with both ends of a link refutes it, by as much as a further link that agrees speaks for a
    cut: that is what tells a link that is merely wrong from the only one that joins two places.
    """
    found = []
    for row in np.flatnonzero(~agrees & far_off(poses, links) & (links.confidence > 0.5)).tolist():
        between = int((near[links.source[row]] & near[links.target[row]]).sum())
        odds = _logit(links.confidence[row]) + between * math.log(ALIKE)
        if odds > 0:
            found.append((row, odds))
    return found


def far_off(poses: Array, links: Links) -> NDArray[np.bool_]:
    """Which links (L,) the poses make wrong beyond doubt."""
    return far(residuals(poses, links))


def far(twist: Array) -> NDArray[np.bool_]:
    """Whether twists (..., 6) are too large for two poses to mean the same."""
    size = np.linalg.norm(twist.reshape(*twist.shape[:-1], 2, 3), axis=-1)
    return np.asarray((size > [WRONG_ANGLE, WRONG_SHIFT]).any(-1))


def _sides(count: int, links: Links, forest: list[int]) -> tuple[list[int], list[NDArray[np.bool_]]]:
    """The tree that each scan is in (its first scan), and for each link of the forest the scans (N,) beyond it."""
    ways: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for place, row in enumerate(forest):
        source, target = int(links.source[row]), int(links.target[row])
        ways[source].append((target, place))
        ways[target].append((source, place))
    tree, order, sides = [-1] * count, [], [np.zeros(count, bool) for _ in forest]
    parent: list[tuple[int, int] | None] = [None] * count
    for root in range(count):
        waiting = [root] if tree[root] < 0 else []
        for scan in waiting:  # grows as it goes: breadth first
            tree[scan] = root
            order.append(scan)
            for other, place in ways[scan]:
                if tree[other] < 0 and parent[scan] != (other, place):
                    parent[other] = (scan, place)
                    waiting.append(other)
    below = np.eye(count, dtype=bool)
    for scan in reversed(order):
        if (up := parent[scan]) is not None:
            sides[up[1]] = below[scan]
            below[up[0]] |= below[scan]
    return tree, sides


def _components(count: int, links: Links, rows: list[int], first: int | None) -> list[list[int]]:
    """The sets of scans that links join, the largest first; in each, the scan to measure from comes first."""
    tree, _ = _sides(count, links, rows)
    sets: dict[int, list[int]] = {}
    for scan, root in enumerate(tree):
        sets.setdefault(root, []).append(scan)
    ordered = sorted(sets.values(), key=lambda scans: (-len(scans), scans[0]))
    return [sorted(scans, key=lambda scan: (scan != first, scan)) for scans in ordered]


def _why_alone(scan: int, links: Links, cuts: list[Cut], names: list[str]) -> str:
    """Why a scan has no pose."""
    own = np.flatnonzero((links.source == scan) | (links.target == scan))
    if not len(own):
        return "no link: it could not be registered with any scan"
    against = [cut.against for cut in cuts if cut.against is not None and scan in _ends(cut.link, links)]
    if against:
        return f"links contradict each other: {_told(against[0], links, names)} does not agree with the others"
    best = own[np.argmax(links.confidence[own])]
    return f"no trustworthy link: the best is {_told(int(best), links, names)}"


def _ends(row: int, links: Links) -> tuple[int, int]:
    return int(links.source[row]), int(links.target[row])


def _told(row: int, links: Links, names: list[str]) -> str:
    source, target = _ends(row, links)
    return f"{names[source]} to {names[target]} (confidence {math.floor(100 * links.confidence[row]) / 100:.2f})"


def _logit(probability: float) -> float:
    clipped = min(max(float(probability), 1e-9), 1 - 1e-9)
    return math.log(clipped / (1 - clipped))


def _logistic(value: float) -> float:
    return 1 / (1 + math.exp(-value))
