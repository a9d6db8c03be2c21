"""Objects that fix a place: posts, boxes, cars, doors, niches; and halls that have some."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam.lab.data.scene import Scene, yawed

__all__ = ["WALL", "car", "car_size", "hall", "scatter"]

Array = NDArray[np.float64]

WALL = 0.3
"""Thickness of walls and slabs."""


def post(scene: Scene, rng: np.random.Generator, x: float, y: float, label: int) -> None:
    """A post, thin or as thick as a trunk."""
    height, width = rng.uniform(0.8, 4), rng.uniform(0.08, 0.5)
    scene.add("cylinder", (x, y, height / 2), (width, width, height), label=label)


def crate(scene: Scene, rng: np.random.Generator, x: float, y: float, label: int) -> None:
    """A box that stands on the ground, at any heading."""
    size = rng.uniform(0.3, 1.6, 3)
    scene.add("box", (x, y, size[2] / 2), size, yawed(rng.uniform(0, np.pi)), label)


def car(scene: Scene, x: float, y: float, turn: float, size: Array, label: int = -1) -> None:
    """A car of a length, width and height (3,): a body and a cabin on it, towards the rear."""
    axes = yawed(turn)
    length, width, height = size
    rear = axes @ (-0.08 * length, 0, 0)
    scene.add("box", (x, y, 0.2 + 0.2 * height), (length, width, 0.4 * height), axes, label)
    scene.add(
        "box", (x + rear[0], y + rear[1], 0.65 * height + 0.1), (0.5 * length, 0.85 * width, height / 2), axes, label
    )


def car_size(rng: np.random.Generator) -> Array:
    """Length, width and height (3,) of cars and vans."""
    return rng.uniform((3.6, 1.6, 1.35), (5.4, 2.0, 2.1))


def scatter(scene: Scene, rng: np.random.Generator, count: int, low: float, high: float, span: float) -> None:
    """Objects on the ground on either side, ``low`` to ``high`` beside the middle and ``span`` along."""
    for x in rng.uniform(-span, span, count):
        y = rng.choice([-1, 1]) * rng.uniform(low, high)
        kind, label = rng.random(), scene.another()
        if kind < 0.45:
            post(scene, rng, x, y, label)
        elif kind < 0.8:
            crate(scene, rng, x, y, label)
        elif high > 3:
            car(scene, x, y, rng.normal(scale=0.2), car_size(rng), label)
        else:
            size = rng.uniform(0.3, 0.9, 3)
            scene.add("ellipsoid", (x, y, size[2] / 2), size, yawed(rng.uniform(0, np.pi)), label)


def wall(scene: Scene, rng: np.random.Generator, side: int, half: float, height: float, openings: list[float]) -> None:
    """A wall along x whose inner face is ``half`` beside the middle, with niches or doorways about these places."""
    y, start = side * (half + WALL / 2), -scene.length
    for x in [*sorted(openings), np.inf]:
        width, top = rng.uniform(0.7, 1.6), min(rng.uniform(1.8, 2.4), 0.95 * height)
        end = min(x - width / 2, scene.length)
        if end < start:
            continue
        scene.add("box", ((start + end) / 2, y, height / 2), (end - start, WALL, height))
        if np.isfinite(x):
            depth = rng.uniform(0.12, 0.6)
            behind = side * (half + depth + WALL / 2)
            label = scene.another()
            scene.add("box", (x, behind, height / 2), (width, WALL, height), label=label)
            scene.add("box", (x, y, (top + height) / 2), (width, WALL, height - top), label=label)
            # jambs where the niche is deeper than the wall is thick
            for edge in (-1, 1):
                jamb = (x + edge * (width / 2 + 0.05), y + side * WALL, height / 2)
                scene.add("box", jamb, (0.1, 2 * WALL, height), label=label)
        start = x + width / 2


def frame(scene: Scene, rng: np.random.Generator, x: float, side: int, half: float, height: float) -> None:
    """A door's frame, a cupboard or a notice board that stands out of a wall."""
    label, out = scene.another(), rng.uniform(0.04, 0.25)
    y = side * (half - out / 2)
    kind = rng.random()
    if kind < 0.5:
        width, top = rng.uniform(0.8, 1.4), min(2.1, 0.9 * height)
        for edge in (-1, 1):
            scene.add("box", (x + edge * width / 2, y, top / 2), (0.12, out, top), label=label)
        scene.add("box", (x, y, top), (width + 0.12, out, 0.12), label=label)
    else:
        size = rng.uniform(0.4, 1.5, 2)
        low = 0.0 if kind < 0.75 else rng.uniform(0.3, max(0.35, height - size[1] - 0.1))
        scene.add("box", (x, y, low + size[1] / 2), (size[0], out, min(size[1], height - low)), label=label)


def hall(scene: Scene, rng: np.random.Generator, half: float, height: float, furnished: int) -> None:
    """Floor, ceiling and two walls, with so many doors, niches, boxes and posts."""
    length = 2 * scene.length
    scene.add("box", (0, 0, -WALL / 2), (length, 2 * half + 2, WALL))
    scene.add("box", (0, 0, height + WALL / 2), (length, 2 * half + 2, WALL))
    openings: dict[int, list[float]] = {-1: [], 1: []}
    span = min(12.0, scene.reach)
    for x in rng.uniform(-span, span, furnished):
        side, kind = int(rng.choice([-1, 1])), rng.random()
        if kind < 0.3 and all(abs(x - other) > 1.8 for other in openings[side]):
            openings[side].append(x)
        elif kind < 0.65:
            frame(scene, rng, x, side, half, height)
        elif kind < 0.85:
            label, size = (
                scene.another(),
                rng.uniform((0.2, 0.2, 0.3), (1.2, 0.7, 1.8)).clip(None, (9, half / 2, height)),
            )
            scene.add("box", (x, side * (half - size[1] / 2), size[2] / 2), size, label=label)
        else:
            label, width = scene.another(), rng.uniform(0.1, 0.35)
            scene.add("cylinder", (x, side * (half - width), height / 2), (width, width, height), label=label)
    for side, places in openings.items():
        wall(scene, rng, side, half, height, places)
