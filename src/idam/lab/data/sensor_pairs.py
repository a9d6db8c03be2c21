"""Pairs of scans with the sensors' own patterns in them, whose place something in the scene fixes, or nothing does.

The same generator teaches and calibrates: everything depends on the random numbers alone. Lengths are in metres, and
each scan is in its sensor's own frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from idam.clouds.frame import common_frame, without_strays
from idam.clouds.pyramid import level
from idam.lab.data.drilled import Drilled, random_drilled, random_flange
from idam.lab.data.parts import random_part, sample_surface
from idam.lab.data.raycast import cast, cast_drilled, depth_image
from idam.lab.data.scenes import SCENES, Scene, Symmetry, about, draw_scene
from idam.lab.data.sensors import RAYS, Sensor, draw_sensor
from idam.lab.data.surfaces import unit, warp
from idam.rigid import adjoint, apply, inverse, transform

__all__ = ["FAMILIES", "SensorPair", "draw_part_in_whole", "draw_sensor_pair", "overlap_of"]

Array = NDArray[np.float64]

FAMILIES = (*SCENES, "part", "flange")
"""What pairs show: scenes from two places, and one-sided views of parts against the whole."""
FEWEST = 2000
"""Points of a scan at least."""
SEEN, UNSEEN, SHARE = 30, 3, 0.004
"""Points that show an object; points that do not; and the share of a scan that all that fixes its place makes up."""
LEAST_OVERLAP = 0.1
"""Below, pairs are drawn again."""
TOUCHING = 1.2
"""Spacings within which surfaces overlap."""
LEVEL = 1024
"""Points of the larger scan at which the overlap is measured: about what :func:`idam.register` matches."""
SAME = 0.65
"""Share of pairs whose scans are from the same sensor."""
WHOLE = (3000, 20_000)
"""Points of a whole model."""
DRILLED = 0.6
"""Share of parts that are drilled; the others are meshes."""
SHARP = 0.6
"""Share of views of parts without bleeding edges."""
EXTENTS = (0.03, 30.0)
"""Radii of parts: no unit is assumed."""


@dataclass(frozen=True)
class SensorPair:
    """Two scans of one scene.

    Attributes:
        source: (N, 3).
        target: (P, 3).
        transformation: the truth (4, 4), ``T_target_source``.
        family: one of :data:`FAMILIES`.
        free: motions that the scans leave free, in the source's frame: the truth times exp(s twist) fits as well, for
            any s, or for whole numbers where the scene repeats. Empty where something both scans see fixes the place.
        sensors: kinds of the source's and the target's sensor.
    """

    source: Array
    target: Array
    transformation: Array
    family: str
    free: tuple[Symmetry, ...]
    sensors: tuple[str, str]

    @cached_property
    def overlap(self) -> float:
        """Share of the scan that overlaps less, where both are as sparse as they are matched."""
        frame = common_frame(self.source, self.target)
        scans = level(without_strays(frame.source(self.source)), without_strays(frame.target(self.target)), LEVEL)
        return overlap_of(scans.source, scans.target, frame.enter(self.transformation), scans.spacing)


def overlap_of(source: Array, target: Array, transformation: Array, spacing: float) -> float:
    """The smaller of the shares of (N, 3) and (P, 3) with a point of the other near by, under the truth (4, 4)."""
    moved, reach = apply(transformation, source), TOUCHING * spacing
    shares = [np.mean(cKDTree(a).query(b)[0] < reach) for a, b in ((target, moved), (moved, target))]
    return float(min(shares))


def draw_sensor_pair(rng: np.random.Generator, family: str | None = None) -> SensorPair:
    """A pair of scans, a function of the generator's state.

    Args:
        rng: random numbers.
        family: one of :data:`FAMILIES`; None for any.
    """
    family = family or str(rng.choice(FAMILIES))
    while True:
        pair = _draw_part(rng, family) if family in ("part", "flange") else _draw_scene_pair(rng, family)
        if pair is not None and pair.overlap >= LEAST_OVERLAP:
            return pair


def _draw_scene_pair(rng: np.random.Generator, family: str) -> SensorPair | None:
    """None where the scans show too little, or where it is a matter of taste whether their place is fixed."""
    scene = draw_scene(family, rng)
    sensors = [draw_sensor(str(rng.choice(scene.sensors)), rng).within(scene.reach)]
    same = rng.random() < SAME
    sensors.append(sensors[0] if same else draw_sensor(str(rng.choice(scene.sensors)), rng).within(scene.reach))
    if np.ptp(scene.places, axis=0).max() > 0.6 * min(sensor.farthest for sensor in sensors):
        return None
    poses = _poses(scene, rng)
    clouds, counts = [], []
    for sensor, pose in zip(sensors, poses, strict=True):
        points, label = _scan(scene, sensor, pose, rng)
        clouds.append(points)
        counts.append(np.bincount(label[label >= 0], minlength=scene.objects))
    if min(map(len, clouds)) < FEWEST:
        return None
    free = _free(scene, np.array(counts), min(map(len, clouds)))
    if free is None:
        return None
    into = adjoint(inverse(poses[0]))
    free = tuple(replace(symmetry, twist=into @ symmetry.twist) for symmetry in free)
    names = sensors[0].name, sensors[1].name
    return SensorPair(clouds[0], clouds[1], inverse(poses[1]) @ poses[0], family, free, names)


def _poses(scene: Scene, rng: np.random.Generator) -> list[Array]:
    """Of the two sensors, (4, 4) each: headed along the way or any way, and tilted, mostly a little."""
    ahead = rng.choice([0.0, np.pi]) + rng.normal(scale=0.4)
    turned = rng.uniform(0, 2 * np.pi) if rng.random() < 0.4 else rng.normal(scale=0.3)
    poses = []
    for heading, place in zip((ahead, ahead + turned), scene.places, strict=True):
        tilt = np.radians(rng.uniform(8, 30) if rng.random() < 0.15 else abs(rng.normal(scale=3.0)))
        axis = rng.uniform(0, 2 * np.pi)
        rotation = Rotation.from_euler("z", heading) * Rotation.from_rotvec(
            [tilt * np.cos(axis), tilt * np.sin(axis), 0]
        )
        poses.append(transform(rotation.as_matrix(), place))
    return poses


def _scan(scene: Scene, sensor: Sensor, pose: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Points (N, 3) in the sensor's frame, and the labels (N,) of what they are on."""
    hits = cast(scene.solids, scene.ground, pose[:3, 3], sensor.directions @ pose[:3, :3].T, sensor.farthest)
    measured = sensor.measure(hits.distance, rng)
    back = np.isfinite(measured)
    return sensor.directions[back] * measured[back, None], hits.label[back]


def _free(scene: Scene, counts: NDArray[np.int64], points: int) -> tuple[Symmetry, ...] | None:
    """What is free, in the world's frame, by how often each scan sees each object (2, objects); None where unclear."""
    if not scene.symmetries:
        return ()
    both = counts.min(0)
    fixing = both >= SEEN
    if fixing.sum() >= scene.needed and both[fixing].sum() >= SHARE * points:
        return ()
    if (both > UNSEEN).any():
        return None
    if (counts > UNSEEN).any():
        # what one scan alone sees tells the repeats apart, where the other ought to see it
        return tuple(symmetry for symmetry in scene.symmetries if symmetry.kind != "repeat") or None
    return scene.symmetries


def draw_part_in_whole(rng: np.random.Generator, meshes: Sequence[Any] = ()) -> SensorPair:
    """A one-sided view of a part, and points all over its model; either may be the source.

    Args:
        rng: random numbers.
        meshes: trimesh meshes to bend and to view, besides parts of our own.
    """
    while True:
        pair = _draw_part(rng, "part", meshes)
        if pair is not None and pair.overlap >= LEAST_OVERLAP:
            return pair


def _draw_part(rng: np.random.Generator, family: str, meshes: Sequence[Any] = ()) -> SensorPair | None:
    """None where the view shows too little, or not whether a flange has a key."""
    count, width = int(rng.integers(*WHOLE)), int(np.sqrt(rng.uniform(*RAYS)))
    order, key = 0, None
    part: Drilled | None = None
    if family == "flange":
        part, order, key = random_flange(rng)
    elif rng.random() < DRILLED:
        part = random_drilled(rng)
    mesh: Any = _random_mesh(rng, meshes) if part is None else None
    whole = sample_surface(mesh, count, rng) if part is None else part.sample(count, rng)

    middle = (whole.min(0) + whole.max(0)) / 2
    radius = float(np.linalg.norm(whole - middle, axis=1).max())
    axes = Rotation.random(random_state=rng).as_matrix()  # the camera's, as columns: it looks along the third
    away = radius * rng.uniform(2.5, 6)
    pose = transform(axes, middle - away * axes[:, 2])
    across = 1.03 * radius / np.sqrt(away**2 - radius**2) * np.linspace(-1, 1, width)
    rays = np.stack([*np.meshgrid(across, across), np.ones((width, width))], -1).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    rays /= lengths[:, None]
    if part is None:
        distance = depth_image(apply(inverse(pose), mesh.triangles.reshape(-1, 3)).reshape(-1, 3, 3), across).ravel()
        distance *= lengths
    else:
        distance = cast_drilled(part.solids, part.holes, pose[:3, 3], rays @ axes.T)
    camera = Sensor("camera", rays, 0.0, np.inf, radius * 0.01 * rng.random() ** 2, image=width)
    if rng.random() < SHARP:
        camera = replace(camera, image=None)
    measured = camera.measure(distance, rng)
    back = np.isfinite(measured)
    view = rays[back] * measured[back, None]
    if len(view) < FEWEST:
        return None

    free: tuple[Symmetry, ...] = ()
    if family == "flange" and key is None:
        free = (about((0, 0, 1), (0, 0, 0), order or None),)
    elif key is not None:
        seen = replace(key, half=1.05 * key.half).holds(apply(pose, view)).sum()
        if seen < max(SEEN, SHARE * len(view)):
            return None
    scale = np.exp(rng.uniform(*np.log(EXTENTS))) / radius
    pose[:3, 3] *= scale
    view, whole = scale * view, scale * whole
    if rng.random() < 0.5:
        return SensorPair(whole, view, inverse(pose), family, free, ("model", "camera"))
    into = adjoint(inverse(pose))
    free = tuple(replace(symmetry, twist=into @ symmetry.twist) for symmetry in free)
    return SensorPair(view, whole, pose, family, free, ("camera", "model"))


def _random_mesh(rng: np.random.Generator, meshes: Sequence[Any]) -> Any:
    """One of the meshes, bent, or a part of primitives stuck into each other."""
    import trimesh

    if not meshes or rng.random() < 0.3:
        return random_part(rng)
    mesh = meshes[int(rng.integers(len(meshes)))]
    return trimesh.Trimesh(warp(unit(np.asarray(mesh.vertices)), rng), mesh.faces, process=False)
