"""Which pairs of scans to register: all of a few scans; of many the likeliest, then those that the poses suggest."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from idam.many.partners import all_pairs
from idam.rigid import Array

__all__ = ["ALL_PAIRS", "PARTNERS", "Choice", "likeliest"]

Pair = tuple[int, int]
"""Two scans, the smaller number first."""

ALL_PAIRS = 30
"""Scans up to which every pair is registered."""
PARTNERS = 4
"""Likeliest partners of each scan that are registered where there are more scans, and links that each should have."""
MORE = 3
"""Rounds after the first."""
FURTHER = 3
"""Likely partners in other components that a scan without a sure pose tries in each of them."""
OVERLAPPING = 0.3
"""Share that the poses must put on each other for a pair to be registered on their account: less holds little."""


@dataclass
class Choice:
    """Which pairs to register next, round by round.

    First the pairs that starting poses put on each other, if there are any; then all, or each scan's likeliest. After
    that what the poses found so far put on each other: such pairs register fast, close loops, and check what hangs on
    few links. Scans that are unsure still look for further likely partners.

    Attributes:
        count: of scans.
        partners: likely partners of each to begin with; None to choose.
        likeliness: gives how likely each two show one place, (N, N), when it is needed.
        tried: pairs so far.
    """

    count: int
    partners: int | None
    likeliness: Callable[[], Array]
    tried: set[Pair] = field(default_factory=set)
    _scores: Array | None = None
    _round: int = 0

    def first(self, overlaps: dict[Pair, float]) -> list[Pair]:
        """The pairs that starting poses put on each other, those that most do."""
        return self._noted(most(overlaps, dict.fromkeys(range(self.count), self._wanted), self.tried))

    def next(
        self, unsure: Collection[int], links: Sequence[int], overlaps: dict[Pair, float], component: Sequence[int]
    ) -> list[Pair]:
        """The pairs of the next round; none where there is no more to try.

        Args:
            unsure: scans without a sure pose so far.
            links: of each scan, how many the poses follow.
            overlaps: by pair, the share that the poses put on each other.
            component: the number of the one that each scan is in.
        """
        self._round += 1
        if self.partners is None and self.count <= ALL_PAIRS:
            pairs = {pair for pair in all_pairs(self.count) if not set(pair).isdisjoint(unsure)}
            return self._noted(pairs - self.tried)
        if self._round > 1 + MORE:
            return []
        enough = {pair: share for pair, share in overlaps.items() if share >= OVERLAPPING}
        short = {scan: self._wanted - held for scan, held in enumerate(links) if held < self._wanted}
        pairs = most(enough, short, self.tried)
        if unsure:
            if self._scores is None:
                self._scores = self.likeliness()
            known = {pair for pair in all_pairs(self.count) if component[pair[0]] == component[pair[1]]}
            each = self._wanted if self._round == 1 else FURTHER
            pairs |= likeliest(self._scores, each, unsure, self.tried | known)
        if self._round == 1:  # scans mostly come in the order that they were taken in
            pairs |= {(scan, scan + 1) for scan in range(self.count - 1)} - self.tried
        return self._noted(pairs)

    @property
    def _wanted(self) -> int:
        return self.partners or PARTNERS

    def _noted(self, pairs: Collection[Pair]) -> list[Pair]:
        self.tried |= set(pairs)
        return sorted(pairs)


def most(shares: dict[Pair, float], wanted: dict[int, int], tried: Collection[Pair]) -> set[Pair]:
    """For each of some scans so many partners as it wants, those that overlap most, among the pairs not tried."""
    left, pairs = dict(wanted), set()
    for pair in sorted(set(shares) - set(tried), key=lambda pair: (-shares[pair], pair)):
        if any(left.get(scan, 0) > 0 for scan in pair):
            pairs.add(pair)
            left |= {scan: left.get(scan, 0) - 1 for scan in pair}
    return pairs


def likeliest(scores: Array, partners: int, scans: Collection[int], tried: Collection[Pair]) -> set[Pair]:
    """For each of some scans its so many likeliest partners among those not tried.

    Args:
        scores: (N, N), symmetric; 0 for pairs that are out of the question.
        partners: how many.
        scans: which scans look for partners.
        tried: pairs.
    """
    pairs = set()
    for scan in scans:
        order = np.argsort(-scores[scan], kind="stable").tolist()
        fresh = [(min(scan, other), max(scan, other)) for other in order if other != scan and scores[scan, other] > 0]
        pairs |= set([pair for pair in fresh if pair not in tried][:partners])
    return pairs
