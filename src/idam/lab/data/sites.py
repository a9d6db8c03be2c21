"""Sites of many scans with their true poses: buildings of furnished rooms, and objects seen from all around.

Everything depends on the random numbers alone. Each scan is in its sensor's own frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from idam import rigid
from idam.lab.data.objects import WALL
from idam.lab.data.raycast import Kind, Solid, cast, depth_image
from idam.lab.data.scene import yawed
from idam.lab.data.sensors import terrestrial

__all__ = ["Site", "draw_building", "draw_equal_rooms", "draw_views"]

Array = NDArray[np.float64]

FURNITURE = 12
"""Pieces in a room, less those that stand in a scanner's way."""
CLEAR = 0.6
"""Metres around a scanner's place and around doors without furniture."""
DOOR = 1.0, 2.1
"""Width and height of doors."""


@dataclass(frozen=True)
class Site:
    """N scans of one place or object.

    Attributes:
        scans: N arrays of points.
        poses: (N, 4, 4), each scan's frame to the one they share.
    """

    scans: list[Array]
    poses: Array

    def errors(self, poses: Sequence[Array | None], first: int) -> Array:
        """By how many degrees, and by how much of its centroid's place, each scan's pose is off, (N, 2).

        Once scan ``first`` is where it belongs; NaN for scans without a pose.
        """
        off = np.full((len(self.scans), 2), np.nan)
        anchor = poses[first]
        for row, (scan, pose) in enumerate(zip(self.scans, poses, strict=True)):
            if pose is None or anchor is None:
                continue
            expected = rigid.inverse(self.poses[first]) @ self.poses[row]
            actual = rigid.inverse(anchor) @ pose
            centre = scan.mean(0)[None]
            off[row] = (
                np.degrees(rigid.angle(rigid.inverse(expected) @ actual)),
                np.linalg.norm(rigid.apply(expected, centre) - rigid.apply(actual, centre)),
            )
        return off


def draw_building(count: int, points: int, rng: np.random.Generator) -> Site:
    """A terrestrial scanner's way through two rows of rooms and back: in every doorway, and some three in each room.

    Args:
        count: number of scans.
        points: of each scan, about.
        rng: random numbers.
    """
    columns = max(1, round(count / 8))
    widths, depths, height = rng.uniform(4.0, 7.0, columns), rng.uniform(4.0, 6.0, 2), rng.uniform(2.6, 3.2)
    across = np.concatenate([[0.0], np.cumsum(widths)])
    upward = np.array([0.0, depths[0], depths.sum()])
    solids = _slabs(np.array([across[0], upward[0]]), np.array([across[-1], upward[-1]]), height)
    middle_doors = [across[0] + 0.25 * widths[0], across[-1] - 0.25 * widths[-1]]
    for number, y in enumerate(upward):
        solids += _wall(0, y, across[0], across[-1], height, middle_doors if number == 1 else [])
    between = rng.uniform(0.3, 0.7, (2, columns + 1))
    doors: dict[tuple[int, int], Array] = {}  # by row and column: the door that leads on
    for row in (0, 1):
        for wall, x in enumerate(across):
            y = upward[row] + between[row, wall] * depths[row]
            inner = 0 < wall < columns
            solids += _wall(1, x, upward[row], upward[row + 1], height, [y] if inner else [])
            if inner:
                doors[row, wall - 1 if row == 0 else wall] = np.array([x, y])
    doors[0, columns - 1], doors[1, 0] = np.array([[middle_doors[1], upward[1]], [middle_doors[0], upward[1]]])
    way = [(0, column) for column in range(columns)] + [(1, column) for column in reversed(range(columns))]
    places = []
    for number, (row, column) in enumerate(way):
        low, high = np.array([across[column], upward[row]]), np.array([across[column + 1], upward[row + 1]])
        here = count // len(way) + (number < count % len(way))
        inside = [_within(low, high, rng) for _ in range(here - 1)]
        own = np.array([*inside, doors[row, column]][:here])
        solids += _furniture(low, high, height, np.concatenate([own, list(doors.values())]), FURNITURE, rng)
        places.append(own)
    return _scanned(solids, np.concatenate(places), points, rng)


def draw_equal_rooms(points: int, rng: np.random.Generator) -> Site:
    """Two rooms that are alike to the last chair, and a furnished corridor between: scans 0 to 3, 4 to 8, and 9 to 12.

    Args:
        points: of each scan, about.
        rng: random numbers.
    """
    size, height, length = rng.uniform(4.5, 6.5, 2), rng.uniform(2.6, 3.2), rng.uniform(8.0, 11.0)
    half, middle = 1.0, size[1] / 2
    low, high = np.zeros(2), size
    inside = np.array([_within(low, high, rng) for _ in range(8)])
    furniture = _furniture(low, high, height, np.array([*inside, [0, middle], [size[0], middle]]), FURNITURE, rng)
    away = np.array([size[0] + length, 0.0, 0.0])
    solids = _slabs(np.array([0.0, -0.5]), np.array([2 * size[0] + length, size[1] + 0.5]), height)
    for start in (0.0, away[0]):
        for y in (0.0, size[1]):
            solids += _wall(0, y, start, start + size[0], height, [])
        for x in (start, start + size[0]):
            solids += _wall(1, x, 0.0, size[1], height, [middle])
    for side in (-1, 1):
        solids += _wall(0, middle + side * half, size[0], size[0] + length, height, [])
    solids += furniture
    solids += [Solid(s.kind, s.centre + away, s.half, s.axes) for s in furniture]
    along = size[0] + length * np.linspace(0.0, 1.0, 5)
    corridor = np.stack([along, np.full(5, middle)], 1)
    ends = np.array([[size[0], middle - half], [size[0] + length, middle + half]])
    solids += _furniture(ends[0], ends[1], height, corridor, FURNITURE, rng, clear=0.35)
    return _scanned(solids, np.concatenate([inside[:4], corridor, inside[4:] + away[:2]]), points, rng)


def draw_views(
    triangles: Array,
    towards: Array,
    points: int,
    noise: float,
    rng: np.random.Generator,
) -> Site:
    """An object as a depth camera sees it from some directions: each view one-sided, turned in any way.

    Args:
        triangles: corners (F, 3, 3) of a mesh.
        towards: directions (N, 3) from the object's middle to the cameras.
        points: of a view that fills the image, about.
        noise: of the depths, as a share of the object's radius.
        rng: random numbers.
    """
    corners = triangles.reshape(-1, 3)
    middle = (corners.min(0) + corners.max(0)) / 2
    radius = float(np.linalg.norm(corners - middle, axis=1).max())
    width = int(np.sqrt(2 * points))  # an object covers about half of its image
    away = 4 * radius
    across = 1.03 * radius / np.sqrt(away**2 - radius**2) * np.linspace(-1, 1, width)
    rays = np.stack([*np.meshgrid(across, across), np.ones((width, width))], -1).reshape(-1, 3)
    scans, poses = [], []
    for direction in towards / np.linalg.norm(towards, axis=1, keepdims=True):
        axes = _facing(-direction, rng.uniform(0, 2 * np.pi))
        camera = rigid.transform(axes, middle + away * direction)
        depth = depth_image(rigid.apply(rigid.inverse(camera), corners).reshape(-1, 3, 3), across).ravel()
        seen = np.isfinite(depth)
        scan = rays[seen] * (depth[seen] + noise * radius * rng.normal(size=int(seen.sum())))[:, None]
        turned = rigid.transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(scale=radius, size=3))
        scans.append(rigid.apply(turned, scan))
        poses.append(camera @ rigid.inverse(turned))
    return Site(scans, np.stack(poses))


def _facing(direction: Array, roll: float) -> Array:
    """Axes (3, 3) as columns of a camera that looks along a direction."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    rotation: Array = np.stack([side, np.cross(direction, side), direction], 1) @ yawed(roll)
    return rotation


def _scanned(solids: list[Solid], places: Array, points: int, rng: np.random.Generator) -> Site:
    """What a terrestrial scanner sees from places (N, 2), turned about the vertical and hardly tilted."""
    sensor = terrestrial(rng, points)
    scans, poses = [], []
    for place in places:
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)) * Rotation.from_rotvec(
            [*rng.normal(scale=0.02, size=2), 0]
        )
        pose = rigid.transform(turn.as_matrix(), [*place, rng.uniform(1.4, 1.7)])
        hits = cast(solids, None, pose[:3, 3], sensor.directions @ pose[:3, :3].T, sensor.farthest)
        measured = sensor.measure(hits.distance, rng)
        back = np.isfinite(measured)
        scans.append(sensor.directions[back] * measured[back, None])
        poses.append(pose)
    return Site(scans, np.stack(poses))


def _within(low: Array, high: Array, rng: np.random.Generator) -> Array:
    """A place (2,) in a room between corners (2,), away from its walls."""
    place: Array = rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low))
    return place


def _box(low: Sequence[float], high: Sequence[float]) -> Solid:
    low_, high_ = np.array(low, float), np.array(high, float)
    return Solid("box", (low_ + high_) / 2, (high_ - low_) / 2, np.eye(3))


def _slabs(low: Array, high: Array, height: float) -> list[Solid]:
    """Floor and ceiling between corners (2,)."""
    return [_box([*low, z], [*high, z + WALL]) for z in (-WALL, height)]


def _wall(axis: int, place: float, start: float, end: float, height: float, doors: Sequence[float]) -> list[Solid]:
    """A wall along an axis with doors about these places."""
    width, top = DOOR

    def piece(low: float, high: float, bottom: float) -> Solid:
        thin = place - WALL / 4, place + WALL / 4
        ends = ((low, thin[0]), (high, thin[1])) if axis == 0 else ((thin[0], low), (thin[1], high))
        return _box([*ends[0], bottom], [*ends[1], height])

    pieces, reached = [], start
    for door in sorted(doors):
        pieces += [piece(reached, door - width / 2, 0.0), piece(door - width / 2, door + width / 2, top)]
        reached = door + width / 2
    return [*pieces, piece(reached, end, 0.0)]


def _furniture(
    low: Array, high: Array, height: float, free: Array, count: int, rng: np.random.Generator, clear: float = CLEAR
) -> list[Solid]:
    """Cupboards and frames along the walls of a room, tables, posts and cushions in it; none near the places (N, 2)."""
    pieces = []
    for _ in range(count):
        size, kind = rng.uniform((0.25, 0.2, 0.3), (1.5, 0.8, min(2.2, height))), rng.random()
        turn, place = rng.uniform(0, np.pi), rng.uniform(low + 0.3, high - 0.3)
        if kind < 0.55:  # against a wall
            axis, side = int(rng.integers(2)), rng.integers(2)
            size[1] = min(size[1], 0.25 * float(high[1 - axis] - low[1 - axis]))
            place[1 - axis] = (low, high)[side][1 - axis] + (0.5 - side) * (size[1] + WALL / 2)
            turn = axis * np.pi / 2
        bottom = rng.uniform(0.6, height - 1.0) if kind < 0.2 else 0.0  # some hang
        shape: Kind = "box" if kind < 0.8 else "cylinder" if kind < 0.92 else "ellipsoid"
        piece = Solid(shape, np.array([*place, bottom + size[2] / 2]), size / 2, yawed(turn))
        if (np.linalg.norm(free - place, axis=1) > clear + np.hypot(size[0], size[1]) / 2).all():
            pieces.append(piece)
    return pieces
