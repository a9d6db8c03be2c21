"""Range sensors: the rays that they send out, and what becomes of the ranges that come back.

Each leaves a pattern of its own in a cloud: rings, rosettes, even angles, pixels; density that falls with distance.
The patterns travel with the sensor, and nothing of the scene is in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["SENSORS", "Sensor", "draw_sensor"]

Array = NDArray[np.float64]

RAYS = (14_000, 60_000)
"""Rays of a scan: of a 16-ring LiDAR at half its resolution, to a 64-ring one's at all of it."""
FIELDS = ((-15, 15), (-25, 15), (-30, 10), (-25, 3), (-22, 22), (-45, 45), (-16, 7), (-52, 7))
"""Lowest and highest ring, degrees, as spinning LiDARs on the market have them (the last one turned over)."""
RINGS = (16, 32, 40, 64, 128)


@dataclass(frozen=True)
class Sensor:
    """A sensor whose rays are fixed in its own frame: x forward, z up.

    Attributes:
        name: of its kind.
        directions: unit rays (N, 3); those of a camera row by row, image after image.
        nearest: range below which nothing comes back.
        farthest: range beyond which nothing comes back.
        sigma: of the range at any distance.
        growth: of sigma with the square of the range, as triangulation has it, per unit.
        dropout: share of rays without a return near by; at the farthest range half as many again as come back.
        image: width of its square images, where it has some: between what is near and what is far it bleeds.
    """

    name: str
    directions: Array
    nearest: float
    farthest: float
    sigma: float
    growth: float = 0.0
    dropout: float = 0.0
    image: int | None = None

    def within(self, reach: float) -> Sensor:
        """The same with its range cut to ``reach``."""
        return replace(self, farthest=min(self.farthest, reach))

    def measure(self, distance: Array, rng: np.random.Generator) -> Array:
        """The ranges (N,) that it reports of true ``distance`` (N,); infinite where nothing comes back."""
        measured = distance.copy()
        if self.image is not None:
            measured = self._bled(measured, rng)
        measured[(measured < self.nearest) | (measured > self.farthest)] = np.inf
        far = np.where(np.isfinite(measured), measured, 0.0)
        lost = self.dropout + 0.4 * (far / self.farthest) ** 4
        measured[rng.random(len(measured)) < lost] = np.inf
        return np.asarray(measured + (self.sigma + self.growth * far**2) * rng.normal(size=len(measured)))

    def _bled(self, distance: Array, rng: np.random.Generator) -> Array:
        """Ranges (N,) of which a pixel beside something nearer or farther may lie anywhere between the two."""
        images = distance.reshape(-1, self.image or 1, self.image or 1)
        beside = np.roll(images, int(rng.choice([-1, 1])), axis=int(rng.integers(1, 3)))
        both = np.isfinite(images) & np.isfinite(beside)
        gap = np.subtract(beside, images, where=both, out=np.zeros_like(images))
        bleeds = both & (np.abs(gap) > 0.05 * images) & (rng.random(images.shape) < 0.4)
        return np.where(bleeds, images + rng.random(images.shape) * gap, images).ravel()


def draw_sensor(kind: str, rng: np.random.Generator) -> Sensor:
    """A sensor of a kind in :data:`SENSORS`."""
    return SENSORS[kind](rng, int(np.exp(rng.uniform(*np.log(RAYS)))))


def spinning(rng: np.random.Generator, rays: int) -> Sensor:
    """Rings about the vertical, even or closer together about the horizon, each a little off where it should be."""
    rings = int(rng.choice(RINGS))
    low, high = FIELDS[rng.integers(len(FIELDS))]
    place = np.linspace(-1, 1, rings)
    if rng.random() < 0.4:
        place = np.sign(place) * np.abs(place) ** rng.uniform(1.2, 1.8)
    step = (high - low) / rings
    upward = (low + high) / 2 + (high - low) / 2 * place + 0.1 * step * rng.normal(size=rings)
    columns = max(180, rays // rings)
    around = 2 * np.pi * (np.arange(columns) + rng.random()) / columns
    around = around[:, None] + np.radians(rng.uniform(0, 1.5)) * rng.normal(size=rings)
    directions = _unit(around, np.radians(upward))
    far = float(rng.choice([60.0, 100.0, 120.0, 200.0]))
    return Sensor("spinning", directions, rng.uniform(0.3, 1.0), far, rng.uniform(0.005, 0.03), dropout=_few(rng))


def rosette(rng: np.random.Generator, rays: int) -> Sensor:
    """A solid-state LiDAR: two prisms at speeds of their own draw petals in a cone; or petals all around."""
    turn = 2 * np.pi * np.arange(rays) / rays
    fast, slow = rng.uniform(60, 140), rng.uniform(20, 50)
    if rng.random() < 0.5:
        cone = np.radians(rng.uniform(38, 80)) / 2
        share = rng.uniform(0.4, 0.6)
        y = cone * (share * np.cos(fast * turn) + (1 - share) * np.cos(-slow * turn))
        z = cone * (share * np.sin(fast * turn) + (1 - share) * np.sin(-slow * turn))
        directions = _unit(y, z)
    else:
        middle, half = np.radians(rng.uniform(5, 25)), np.radians(rng.uniform(20, 32))
        directions = _unit(fast * turn, middle + half * np.sin((fast * slow + rng.random()) * turn))
    far = float(rng.choice([40.0, 70.0, 200.0]))
    return Sensor("rosette", directions, rng.uniform(0.1, 0.8), far, rng.uniform(0.01, 0.03), dropout=_few(rng))


def terrestrial(rng: np.random.Generator, rays: int) -> Sensor:
    """Even angles all around, from steeply below to the zenith: crowded at the foot of the tripod and overhead."""
    low, high = np.radians(rng.uniform(-65, -50)), np.radians(rng.uniform(60, 90))
    rows = int(np.sqrt(rays * (high - low) / (2 * np.pi)))
    columns = rays // rows
    around = 2 * np.pi * (np.arange(columns) + rng.random()) / columns
    directions = _unit(around[:, None], np.linspace(low, high, rows))
    return Sensor("terrestrial", directions, 0.4, rng.uniform(50, 120), rng.uniform(0.001, 0.005), dropout=_few(rng))


def camera(rng: np.random.Generator, rays: int) -> Sensor:
    """A depth camera that looks around: three to six images, each turned on from the last, from one place."""
    looks = int(rng.integers(3, 7))
    width = int(np.sqrt(rays / looks))
    across = np.tan(np.radians(rng.uniform(50, 75) / 2)) * np.linspace(-1, 1, width)
    y, z = np.meshgrid(-across, -across)
    pixels = np.stack([np.ones_like(y), y, z], -1).reshape(-1, 3)
    pixels /= np.linalg.norm(pixels, axis=1, keepdims=True)
    step = np.radians(rng.uniform(35, 70))
    images = []
    for look in range(looks):
        turn, nod = step * (look - looks / 2), np.radians(rng.uniform(-20, 12))
        images.append(pixels @ _looking(turn, nod).T)
    growth = rng.uniform(0.0008, 0.003)
    return Sensor(
        "camera", np.concatenate(images), 0.3, rng.uniform(4, 9), 0.001, growth=growth, dropout=_few(rng), image=width
    )


SENSORS: dict[str, Callable[[np.random.Generator, int], Sensor]] = {
    "spinning": spinning,
    "rosette": rosette,
    "terrestrial": terrestrial,
    "camera": camera,
}
"""The kinds of sensors."""


def _few(rng: np.random.Generator) -> float:
    """A share of returns that are lost: mostly hardly any."""
    return float(0.15 * rng.random() ** 3)


def _unit(around: Array, upward: Array) -> Array:
    """Unit rays (N, 3) by azimuth and elevation, of shapes that broadcast."""
    around, upward = np.broadcast_arrays(around, upward)
    level = np.cos(upward)
    rays: Array = np.stack([level * np.cos(around), level * np.sin(around), np.sin(upward)], -1).reshape(-1, 3)
    return rays


def _looking(turn: float, nod: float) -> Array:
    """The rotation (3, 3) of a camera that nods (upwards) and then turns about the vertical."""
    (c, s), (cn, sn) = (np.cos(turn), np.sin(turn)), (np.cos(nod), np.sin(nod))
    turned, nodded = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[cn, 0, -sn], [0, 1, 0], [sn, 0, cn]])
    rotation: Array = turned @ nodded
    return rotation
