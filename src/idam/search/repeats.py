"""Where else the scans fit: shifted, and turned by half, as far as their surfaces and what they saw through tell.

Bays, pillars, stalls and steps lie on each other one further, too, and a hall on itself the other way round. Features
that know a scanner's pattern know nothing of that. So for a pose's rotation, and its half turns about the principal
directions of the normals, every shift is asked at once how much of each scan it lays on the other's surface, less what
it puts where the other scan saw through: a correlation of two maps, by the Fourier transform. What is rare tells more:
walls and floors fix a direction each with most of the points, and a few posts the third. So a cell counts by its
normals' leverage in the sum of squared motions along normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces
from idam.clouds.viewpoint import FreeSpace
from idam.rigid import Array

__all__ = ["repeats"]

CELL = 1 / 32
"""Length of a cell at least, in working units: half a metre of a street, a stall is five."""
MOST_CELLS = 100_000
"""Cells of the correlation at most, about: where there were more, cells are larger. At 1/32 a street
takes 110,000, a room 130,000, rows of parked cars 280,000; a bunny takes 60 ms with 300,000."""
THROUGH = 5.0
"""Cells on the other scan's surface that one in its free space counts as much as: 2, 5 and 10 rank alike."""
PLACES = 6
"""Poses that are looked at."""
ALMOST = 0.6
"""Share of the pose's own score below which another is not looked at."""
APART = 2
"""Cells around a shift that belong to it."""
INSIDE = 0.01
"""Share of the points at either end of an axis that the map leaves out: they are few and far."""
FLAT = 0.01
"""Least share of the normals that a direction is taken to have: there may be none."""
ALIGNED, STEPS = 0.94, 4
"""|cosine| within which normals tell where a principal direction points, and how often they are asked."""
RAYS = 1500
"""Rays that tell what a scan saw through."""
CLEAR, SHORT = 2.5, 0.97
"""Cells by which free space ends before what was seen, and the share of the ray that it ends at."""

Map = NDArray[np.float32]
Spectrum = NDArray[Any]


@dataclass(frozen=True)
class _Mapped:
    """A cloud on a grid along the principal directions.

    Attributes:
        low: the first cell, (3,).
        share: of the cloud's leverage in each cell, (A, B, C), sum 1.
        fit: what it is worth to lay something there, (A, B, C): 1 on the surface and beside it, less than nothing where
            the scan saw through.
    """

    low: NDArray[np.int64]
    share: Map
    fit: Map


def repeats(surfaces: Surfaces, free_space: FreeSpace, transformation: Array) -> Array:
    """Poses (S, 4, 4) at which two clouds fit nearly as well as at a pose (4, 4), the best first, without it."""
    axes = _principal(surfaces.target.normals)
    into = axes @ transformation[:3, :3]
    ends = [_ends(points) for points in (surfaces.source.points @ into.T, surfaces.target.points @ axes.T)]
    extent = sum(np.ptp(each, axis=0) for each in ends)
    cell = max(CELL, surfaces.spacing, float(np.cbrt(np.prod(extent) / MOST_CELLS)))
    normals = np.concatenate([surfaces.source.normals @ into.T, surfaces.target.normals @ axes.T])
    rarity = 1 / np.maximum((normals**2).mean(0), FLAT)
    eyes = [None if depth is None else depth.eye for depth in (free_space.source_depth, free_space.target_depth)]
    source = _mapped(surfaces.source, eyes[0], into, ends[0] / cell, cell, rarity)
    target = _mapped(surfaces.target, eyes[1], axes, ends[1] / cell, cell, rarity)
    score = _correlations(source, target)
    own = np.rint(axes @ transformation[:3, 3] / cell).astype(np.int64) - target.low + source.low
    near = [np.arange(at - APART, at + APART + 1) % n for at, n in zip(own.tolist(), score.shape[1:], strict=True)]
    least = max(0.0, ALMOST * float(score[0][np.ix_(*near)].max()))
    score[0][np.ix_(*near)] = -np.inf
    chosen: list[NDArray[np.int64]] = []
    for place in _peaks(score, least):
        if len(chosen) < PLACES and all(_apart(place, other) for other in chosen):
            chosen.append(place)
    poses = [_pose(place.tolist(), source, target, axes, into, cell, score.shape[1:]) for place in chosen]
    return np.array(poses).reshape(-1, 4, 4)


def _principal(normals: Array) -> Array:
    """Directions (3, 3), as rows, that most normals (N, 3) point along, the commonest first, perpendicular."""
    axes = np.linalg.eigh(normals.T @ normals)[1].T[::-1]
    rows: list[Array] = []
    for axis in axes[:2]:
        for _ in range(STEPS):
            near = normals[np.abs(normals @ axis) > ALIGNED]
            axis = np.linalg.eigh(near.T @ near)[1][:, -1] if len(near) else axis
        rows.append(axis)
    second = rows[1] - rows[0] * (rows[0] @ rows[1])
    if np.linalg.norm(second) < 1 - ALIGNED:  # both came to rest on one
        second = axes[1] - rows[0] * (rows[0] @ axes[1])
    second /= np.linalg.norm(second)
    return np.stack([rows[0], second, np.cross(rows[0], second)])


def _ends(points: Array) -> Array:
    """Where points (N, 3) begin and end along each axis, but for a few strays, (2, 3)."""
    return np.asarray(np.quantile(points, (INSIDE, 1 - INSIDE), axis=0))


def _mapped(surface: Surface, eye: Array | None, axes: Array, ends: Array, cell: float, rarity: Array) -> _Mapped:
    """A cloud on a grid along axes (3, 3) between ends (2, 3) in cells, by how rare normals along each are, (3,)."""
    points, normals = surface.points @ axes.T / cell, surface.normals @ axes.T
    least, most = ends
    inside = ((points >= least - APART) & (points <= most + APART)).all(1)
    points, normals = points[inside], normals[inside]
    low = np.floor(points.min(0)).astype(np.int64) - 1
    size = tuple(int(n) for n in np.floor(points.max(0)).astype(np.int64) - low + 2)
    number = int(np.prod(size))
    at = np.ravel_multi_index(tuple((np.floor(points).astype(np.int64) - low).T), size)
    count = np.bincount(at, minlength=number)
    leverage = np.bincount(at, normals**2 @ rarity, minlength=number) / np.maximum(count, 1)
    near = _dilated((count > 0).reshape(size))
    free = np.zeros(size, bool) if eye is None else _seen_through(surface.points[inside], eye, axes, cell, low, size)
    fit = np.where(near, 1.0, np.where(free, -THROUGH, 0.0))
    share = (leverage / leverage.sum()).reshape(size)
    return _Mapped(low, share.astype(np.float32), fit.astype(np.float32))


def _dilated(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells and the cells next to them; those at the edges are empty."""
    for axis in range(3):
        cells = cells | np.roll(cells, 1, axis) | np.roll(cells, -1, axis)
    return cells


def _seen_through(
    points: Array, eye: Array, axes: Array, cell: float, low: NDArray[np.int64], size: tuple[int, ...]
) -> NDArray[np.bool_]:
    """The cells of a grid that rays from a place (3,) to points (N, 3) pass."""
    ray = points[:: len(points) // RAYS + 1] - eye
    length = np.linalg.norm(ray, axis=1)
    step = (np.arange(int(length.max() / cell)) + 0.5) * cell
    row, column = np.nonzero(step < (SHORT * length - CLEAR * cell)[:, None])
    passed = eye + ray[row] * (step[column] / length[row])[:, None]
    at = np.floor(passed @ axes.T / cell).astype(np.int64) - low
    at = at[((at >= 0) & (at < size)).all(1)]
    free = np.zeros(size, bool)
    free[tuple(at.T)] = True
    return free


def _correlations(source: _Mapped, target: _Mapped) -> Map:
    """The score (4, U, V, W) of every shift: of no turn, and of half turns about each axis."""
    size = tuple(_quick(a + b) for a, b in zip(source.share.shape, target.share.shape, strict=True))
    spectra = [np.fft.rfftn(x, size, (0, 1, 2)) for x in (source.share, source.fit, target.fit, target.share)]
    mine, fits, theirs, shares = spectra
    score = np.empty((4, *size), np.float32)
    for turn in range(4):
        both = _turned(mine, turn) * theirs + _turned(fits, turn) * shares
        score[turn] = np.fft.irfftn(both, size, (0, 1, 2)) / 2
    return score


def _turned(spectrum: Spectrum, turn: int) -> Spectrum:
    """The conjugate spectrum of a map, or of it turned by half about an axis (1 to 3): flipped along the other two."""
    first, second = (-np.arange(n) for n in spectrum.shape[:2])
    if turn == 0:
        return np.conj(spectrum)
    if turn == 3:
        return np.conj(spectrum[np.ix_(first, second)])
    return np.take(spectrum, first, 0, mode="wrap") if turn == 1 else np.take(spectrum, second, 1, mode="wrap")


def _quick(number: int) -> int:
    """The least product of twos, threes and fives that is no less: the Fourier transform takes those faster."""
    powers = range(number.bit_length() + 1)
    sizes: list[int] = [2**a * 3**b * 5**c for a, b, c in product(powers, powers, powers)]
    return min(size for size in sizes if size >= number)


def _peaks(score: Map, least: float) -> NDArray[np.int64]:
    """Turns and shifts (P, 4) of more than the least score, and of no less than those next to them, the best first.

    The flank of a peak is no place of its own: refined, it ends on the way to the peak.
    """
    place = np.argwhere(score > least)
    value = score[tuple(place.T)]
    highest = np.ones(len(place), bool)
    for step in product((-1, 0, 1), repeat=3):
        beside = (place[:, 1:] + step) % score.shape[1:]
        highest &= value >= score[(place[:, 0], beside[:, 0], beside[:, 1], beside[:, 2])]
    order = np.argsort(-value[highest], kind="stable")
    return np.asarray(place[highest][order])


def _apart(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    """Whether two turns and shifts (4,) are places of their own: two peaks may be one in the noise."""
    return bool(one[0] != other[0] or np.abs(one[1:] - other[1:]).max() > APART)


def _pose(
    place: Sequence[int],
    source: _Mapped,
    target: _Mapped,
    axes: Array,
    into: Array,
    cell: float,
    size: tuple[int, ...],
) -> Array:
    """The pose (4, 4) of a place in the scores."""
    turn, shift = place[0], np.array(place[1:])
    sign = np.ones(3) if turn == 0 else 2 * np.eye(3)[turn - 1] - 1
    first = np.where(sign > 0, source.low, -source.low - 1)
    behind = (sign > 0) & (shift >= np.array(target.share.shape))  # of no flip: shifts below zero come last
    shift = np.where(behind, shift - np.array(size), shift) + target.low - first
    return rigid.transform(axes.T @ (sign[:, None] * into), axes.T @ (cell * shift))
