"""Made-up scans of made-up objects, with their true poses."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from idam import rigid
from idam.rigid import Array

BLOBS = 14


def surface(seed: int, count: int, random: np.random.Generator) -> Array:
    """Random points on a lumpy sphere of about unit size that looks the same from nowhere else."""
    shape = np.random.default_rng(seed)
    axes, heights = shape.normal(size=(BLOBS, 3)), shape.uniform(0.15, 0.5, BLOBS)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    widths = shape.uniform(6, 25, BLOBS)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = 0.6 + (heights * np.exp(widths * (direction @ axes.T - 1))).sum(1)
    return np.asarray(direction * radius[:, None] * [1.0, 0.8, 0.65])


@dataclass
class World:
    """Scans, and the pose of each: its coordinates to those of the object."""

    scans: list[Array]
    poses: Array

    def truth(self, source: int, target: int) -> Array:
        """T_target_source."""
        return np.asarray(rigid.inverse(self.poses[target]) @ self.poses[source])

    def errors(self, poses: list[Any], scans: list[int]) -> Array:
        """How far poses are off, in radians and object units, relative to the first of some scans."""
        first = scans[0]
        off = [
            rigid.log(rigid.inverse(self.truth(scan, first)) @ rigid.inverse(poses[first]) @ poses[scan])
            for scan in scans
        ]
        return np.asarray(np.linalg.norm(off, axis=1))


def world(count: int, *, seed: int = 0, points: int = 2000, seen: float = 0.65, scale: float = 1.0) -> World:
    """Views of an object from all around, each of other points, turned in any way."""
    random = np.random.default_rng(seed)
    scans, poses = [], []
    for view in range(count):
        angle = 2 * np.pi * view / count
        towards = np.array([np.cos(angle), np.sin(angle), 0.5 * np.cos(2 * angle)])
        cloud = surface(seed, points, random)
        depth = cloud @ towards
        visible = cloud[depth >= np.quantile(depth, 1 - seen)]
        pose = rigid.exp(np.concatenate([random.normal(scale=1.5, size=3), random.normal(size=3)]))
        pose[:3, 3] *= scale
        scans.append(rigid.apply(rigid.inverse(pose), scale * visible))
        poses.append(pose)
    return World(scans, np.stack(poses))


class Registers:
    """Takes the place of ``idam.register``: the truth with some noise, wrong for some pairs; and it counts."""

    def __init__(self, made: World, wrong: dict[tuple[int, int], float] | None = None, noise: float = 0.002):
        self._made, self._wrong, self._noise = made, wrong or {}, noise
        self._numbers = {scan[0].tobytes(): number for number, scan in enumerate(made.scans)}
        self.calls: list[tuple[int, int]] = []
        self.options: list[dict[str, Any]] = []

    def __call__(self, source: Any, target: Any, **options: Any) -> SimpleNamespace:
        pair = self._numbers[source.points[0].tobytes()], self._numbers[target.points[0].tobytes()]
        self.calls.append(pair)
        self.options.append(options)
        random = np.random.default_rng([*pair])
        right = pair not in self._wrong
        twist = random.normal(scale=self._noise if right else 1.0, size=6)
        return SimpleNamespace(
            transformation=self._made.truth(*pair) @ rigid.exp(twist),
            information=np.eye(6) / self._noise**2,
            confidence=0.97 if right else self._wrong[pair],
            reason="",
            fitness=0.6,
            inlier_rmse=0.01,
            max_correspondence_distance=0.1,
        )
