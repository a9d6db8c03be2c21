"""Made-up graphs of scans whose poses are known: links as registrations would give them, right or wrong.

A link of confidence c is right with probability c, or a little less (``trusting``). What a wrong one says depends on
the family: anything; the same wrong thing as others, where places or objects look alike; or a repeat of the right
answer along a corridor. Lengths are in radii of a scan. Everything depends on the random numbers alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.many.graph import Links
from idam.rigid import Array

__all__ = ["FAMILIES", "MadeGraph", "draw_graph"]

Pairs = list[tuple[int, int]]

SPREAD = 0.002
"""Standard deviation of a right link, in radians and radii."""
COARSE = 0.15
"""Share of right links that are four times as far off as they say: little overlap holds them badly."""


@dataclass(frozen=True)
class MadeGraph:
    """N scans and L links.

    Attributes:
        poses: the truth, (N, 4, 4).
        links: between the scans.
        wrong: (L,) which links are.
        family: one of :data:`FAMILIES`.
    """

    poses: Array
    links: Links
    wrong: NDArray[np.bool_]
    family: str


def draw_graph(rng: np.random.Generator, family: str | None = None, trusting: float = 1.0) -> MadeGraph:
    """A graph, a function of the generator's state.

    Args:
        rng: random numbers.
        family: one of :data:`FAMILIES`; None for any.
        trusting: how many times as often as its confidence says a link is wrong.
    """
    family = family or str(rng.choice(list(FAMILIES)))
    poses, pairs, mistaken = FAMILIES[family](rng)
    source, target = np.array(pairs, np.int64).T
    easy = rng.uniform(0.3, 0.9)  # share of pairs that a registration can decide
    sure = np.where(rng.random(len(pairs)) < easy, rng.beta(12, 1, len(pairs)), rng.beta(0.6, 1.5, len(pairs)))
    confidence = np.clip(sure, 0.002, 0.995)
    wrong = rng.random(len(pairs)) < np.minimum(trusting * (1 - confidence), 1.0)
    off = np.where(rng.random((len(pairs), 1)) < COARSE, 4 * SPREAD, SPREAD) * rng.normal(size=(len(pairs), 6))
    said = np.where(wrong[:, None, None], mistaken(source, target), rigid.inverse(poses[target]) @ poses[source])
    information = np.tile(np.eye(6) / SPREAD**2, (len(pairs), 1, 1))
    return MadeGraph(poses, Links(source, target, said @ rigid.exp(off), information, confidence), wrong, family)


Mistaken = Callable[[NDArray[np.int64], NDArray[np.int64]], Array]
"""What wrong links between scans say, (L, 4, 4)."""


def scattered(rng: np.random.Generator) -> tuple[Array, Pairs, Mistaken]:
    """Scans all over a site, each linked to those around it."""
    poses = turned(rng, rng.uniform(-4, 4, (int(rng.integers(8, 41)), 3)) * [1, 1, 0.2])
    return poses, nearest(poses, int(rng.integers(2, 9))), anything(rng)


def chain(rng: np.random.Generator) -> tuple[Array, Pairs, Mistaken]:
    """A way that comes back to where it began, or does not; each scan linked to the next two or three, few across."""
    count = int(rng.integers(6, 31))
    bend = rng.choice([0.0, 2 * np.pi / count])
    heading = bend * np.arange(count)
    places = np.cumsum(np.stack([np.cos(heading), np.sin(heading), np.zeros(count)], 1), 0)
    reach = int(rng.integers(1, 4))
    pairs = {(i, i + step) for step in range(1, reach + 1) for i in range(count - step)}
    pairs |= {tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(count // 3)}
    if bend:
        pairs |= {(0, count - 1)}
    return turned(rng, places), sorted(pairs), anything(rng)


def corridor(rng: np.random.Generator) -> tuple[Array, Pairs, Mistaken]:
    """A way along which everything repeats: wrong links are off by whole steps."""
    poses, pairs, _ = chain(rng)

    def mistaken(source: NDArray[np.int64], target: NDArray[np.int64]) -> Array:
        slid = np.zeros((len(source), 6))
        slid[:, 3] = rng.choice([-2, -1, 1, 2], len(source)) * 0.7
        return rigid.inverse(poses[target]) @ rigid.exp(slid) @ poses[source]

    return poses, pairs, mistaken


def symmetric(rng: np.random.Generator) -> tuple[Array, Pairs, Mistaken]:
    """Views all around an object that looks nearly alike after a half or a quarter turn: wrong links say it was turned.

    All pairs are linked, as they are for few scans.
    """
    count = int(rng.integers(5, 16))
    poses = turned(rng, rng.normal(scale=0.3, size=(count, 3)))
    step = 2 * np.pi / rng.choice([2, 4])

    def mistaken(source: NDArray[np.int64], target: NDArray[np.int64]) -> Array:
        turn = np.zeros((len(source), 6))
        turn[:, 2] = step * rng.integers(1, round(2 * np.pi / step), len(source))
        return rigid.inverse(poses[target]) @ rigid.exp(turn) @ poses[source]

    return poses, [(i, j) for i in range(count) for j in range(i + 1, count)], mistaken


def alike(rng: np.random.Generator) -> tuple[Array, Pairs, Mistaken]:
    """Two equal rooms and a corridor between them: all links across say that the rooms are one."""
    each, between = int(rng.integers(3, 7)), int(rng.integers(2, 5))
    inside = turned(rng, rng.normal(scale=0.4, size=(each, 3)))
    away = rigid.exp(np.array([0, 0, rng.uniform(-1, 1), between + 1.5, 0, 0]))
    along = turned(rng, np.stack([1.0 + np.arange(between), *np.zeros((2, between))], 1))
    poses = np.concatenate([inside, away @ inside @ rigid.exp(rng.normal(scale=0.2, size=(each, 6))), along])
    room = np.r_[np.zeros(each), np.ones(each), np.full(between, 2)].astype(int)
    first, last = 2 * each, 2 * each + between - 1
    pairs = [(i, j) for i in range(2 * each) for j in range(i + 1, 2 * each)]
    pairs += [(i, first) for i in range(each)] + [(i, last) for i in range(each, 2 * each)]
    pairs += [(i, j) for i in range(first, last + 1) for j in range(i + 1, last + 1)]
    as_one = np.where((room == 1)[:, None, None], rigid.inverse(away) @ poses, poses)
    other = anything(rng)

    def mistaken(source: NDArray[np.int64], target: NDArray[np.int64]) -> Array:
        across = (room[source] < 2) & (room[target] < 2) & (room[source] != room[target])
        same = rigid.inverse(as_one[target]) @ as_one[source]
        return np.where(across[:, None, None], same, other(source, target))

    return poses, pairs, mistaken


FAMILIES: dict[str, Callable[[np.random.Generator], tuple[Array, Pairs, Mistaken]]] = {
    "scattered": scattered,
    "chain": chain,
    "corridor": corridor,
    "symmetric": symmetric,
    "alike": alike,
}
"""The families of graphs."""


def turned(rng: np.random.Generator, places: Array) -> Array:
    """Poses (N, 4, 4) at places (N, 3), turned in any way."""
    return rigid.transform(rigid.rotation_exp(rng.normal(scale=1.5, size=(len(places), 3))), places)


def nearest(poses: Array, partners: int) -> Pairs:
    """Each scan with so many nearest ones."""
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[:, :3, 3], axis=-1)
    near = np.argsort(apart, axis=1)[:, 1 : partners + 1]
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})


def anything(rng: np.random.Generator) -> Mistaken:
    """Any transform about as far as scans overlap."""
    return lambda source, target: turned(rng, rng.normal(scale=0.7, size=(len(source), 3)))
