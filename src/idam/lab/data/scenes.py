"""Scenes to scan that slide, turn or repeat unless something in them fixes the place, in metres.

Each is scenery, whose symmetries are known since it is built of them, and objects of any number, from none to many,
that break them: posts, boxes, doors, niches. The x axis runs along, z upwards; scenery goes on beyond every range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from idam.lab.data.raycast import Ground, Kind, Solid

__all__ = ["SCENES", "Scene", "Symmetry", "draw_scene"]

Array = NDArray[np.float64]

OBJECTS, HOW_OFTEN = (0, 1, 2, 4, 8, 16), (0.3, 0.1, 0.1, 0.15, 0.2, 0.15)
"""Objects that fix the place, along some twenty metres, and how often there are so many."""
WALL = 0.3
"""Thickness of walls and slabs."""


@dataclass(frozen=True)
class Symmetry:
    """A motion that takes scenery to itself.

    Attributes:
        kind: slide or turn, by any amount; or repeat, by whole numbers of steps.
        twist: the motion (6,), rotation before translation: exp(s twist) for any s, or for whole numbers s.
    """

    kind: str
    twist: Array


@dataclass
class Scene:
    """Something to scan.

    Attributes:
        reach: how far sensors see at most: scenery and its symmetries end beyond.
        places: of the two sensors (2, 3).
        symmetries: of the scenery, without the objects.
        sensors: kinds that such scenes are scanned with.
        needed: objects that fix the place together.
        ground: terrain, if any.
        solids: scenery and objects.
        objects: how many there are.
    """

    reach: float
    places: Array
    symmetries: tuple[Symmetry, ...]
    sensors: tuple[str, ...]
    needed: int = 1
    ground: Ground | None = None
    solids: list[Solid] = field(default_factory=list)
    objects: int = 0

    @property
    def length(self) -> float:
        """Half the length of scenery that no sensor sees the end of."""
        return 1.05 * self.reach + float(np.abs(self.places[:, 0]).max())

    def add(self, kind: Kind, centre: object, size: object, axes: Array | None = None, label: int = -1) -> None:
        """One more solid, by its centre (3,) and its lengths (3,)."""
        half = np.asarray(size, float) / 2
        self.solids.append(Solid(kind, np.asarray(centre, float), half, np.eye(3) if axes is None else axes, label))

    def another(self) -> int:
        """The label of one more object."""
        self.objects += 1
        return self.objects - 1


def draw_scene(family: str, rng: np.random.Generator) -> Scene:
    """A scene of a family in :data:`SCENES`, without objects that a sensor would stand in."""
    scene = SCENES[family](rng)
    scene.solids = [s for s in scene.solids if s.label < 0 or not s.holds(scene.places).any()]
    return scene


def yawed(turn: float) -> Array:
    """The rotation (3, 3) about the vertical."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


ALONG = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""Axes of a cylinder that lies along x."""


def slide(x: float, y: float = 0.0, z: float = 0.0) -> Symmetry:
    """Along a direction."""
    return Symmetry("slide", np.array([0, 0, 0, x, y, z], float))


def repeat(x: float, y: float = 0.0, z: float = 0.0) -> Symmetry:
    """Every so far."""
    return Symmetry("repeat", np.array([0, 0, 0, x, y, z], float))


def about(axis: object, point: object, parts: int | None = 2) -> Symmetry:
    """A turn by a whole number of parts about an axis (3,) through a point (3,), or by any angle."""
    angle = 1.0 if parts is None else 2 * np.pi / parts
    turn = angle * np.asarray(axis, float)
    kind = "turn" if parts is None else "repeat"
    return Symmetry(kind, np.concatenate([turn, -np.cross(turn, np.asarray(point, float))]))


UP, ACROSS, LENGTHWISE = (0, 0, 1), (0, 1, 0), (1, 0, 0)


def apart(rng: np.random.Generator, near: float, far: float, across: float, height: tuple[float, float]) -> Array:
    """Two places (2, 3), ``near`` to ``far`` apart along x, up to ``across`` beside the middle, at about one height."""
    step = np.exp(rng.uniform(np.log(near), np.log(far)))
    places = np.zeros((2, 3))
    places[:, 0] = step * np.array([-0.5, 0.5])
    places[:, 1] = rng.uniform(-across, across, 2)
    places[:, 2] = rng.uniform(*height) + rng.normal(scale=0.04, size=2)
    return places


def how_many(rng: np.random.Generator) -> int:
    """Objects that fix the place."""
    return int(rng.choice(OBJECTS, p=HOW_OFTEN))


def post(scene: Scene, rng: np.random.Generator, x: float, y: float, label: int) -> None:
    """A post, thin or as thick as a trunk."""
    height, width = rng.uniform(0.8, 4), rng.uniform(0.08, 0.5)
    scene.add("cylinder", (x, y, height / 2), (width, width, height), label=label)


def crate(scene: Scene, rng: np.random.Generator, x: float, y: float, label: int) -> None:
    """A box that stands on the ground, turned in some way."""
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


def lengthwise(scene: Scene, rng: np.random.Generator, half: float, height: float) -> bool:
    """Perhaps a pipe or a duct under the ceiling, on one side: it slides as the hall does, but has no half turns."""
    if rng.random() < 0.5:
        return False
    size, y = rng.uniform(0.1, 0.35), rng.choice([-1, 1]) * 0.7 * half
    kind: Kind = "cylinder" if rng.random() < 0.5 else "box"
    scene.add(kind, (0, y, height - size), (size, size, 2 * scene.length), ALONG)
    return True


def half_turns(height: float) -> tuple[Symmetry, ...]:
    """Of a hall with a rectangle's section: about the three axes of its middle."""
    middle = (0, 0, height / 2)
    return about(UP, middle), about(LENGTHWISE, middle), about(ACROSS, middle)


def corridor(rng: np.random.Generator) -> Scene:
    """Floor, ceiling, walls; doors, niches, boxes."""
    half, height = rng.uniform(0.7, 2), rng.uniform(2.2, 3.4)
    places = apart(rng, 1, 10, 0.5 * half, (0.4, min(1.8, 0.8 * height)))
    scene = Scene(rng.uniform(12, 30), places, (), ("spinning", "terrestrial", "rosette", "camera"))
    turns = () if lengthwise(scene, rng, half, height) else half_turns(height)
    hall(scene, rng, half, height, how_many(rng))
    scene.symmetries = slide(1), *turns
    return scene


def pillars(rng: np.random.Generator) -> Scene:
    """A hall with pillars, pilasters or bays of windows at even steps along both walls."""
    half, height = rng.uniform(1.2, 5), rng.uniform(2.5, 5)
    places = apart(rng, 1, 15, 0.4 * half, (0.4, 1.8))
    scene = Scene(rng.uniform(15, 30), places, (), ("spinning", "terrestrial", "rosette"))
    period, shift, kind = rng.uniform(1.5, 5), rng.random(), rng.integers(3)
    width, out, low = rng.uniform(0.25, 0.4 * period), rng.uniform(0.12, 0.4), rng.uniform(0.8, 1.2)
    number = int(scene.length / period)
    for x in period * (np.arange(-number, number + 1) + shift):
        for side in (-1, 1):
            y = side * (half - out / 2)
            if kind == 0:
                scene.add("cylinder", (x, y - side * out, height / 2), (width, width, height))
            elif kind == 1:
                scene.add("box", (x, y, height / 2), (width, out, height))
            else:  # a sill and a lintel
                scene.add("box", (x, y, low / 2), (0.6 * period, out, low))
                scene.add("box", (x, y, height - 0.2), (0.6 * period, out, 0.4))
    hall(scene, rng, half, height, how_many(rng))
    upright = about(UP, (period * shift, 0, 0))
    middle = (period * shift, 0, height / 2)
    turns = (upright,) if kind == 2 else (upright, about(LENGTHWISE, middle), about(ACROSS, middle))
    scene.symmetries = repeat(period), *turns
    return scene


def tunnel(rng: np.random.Generator) -> Scene:
    """A bore with a roadway, or a pipe; lamps at even steps, or none."""
    radius = rng.uniform(1.5, 6)
    floor = -rng.uniform(0.3, 0.7) * radius
    places = apart(rng, 2, 25, 0.3 * radius, (0.5, min(2.0, 0.8 * radius)))
    scene = Scene(rng.uniform(25, 80), places, (), ("spinning", "terrestrial", "rosette"))
    scene.add("cylinder", (0, 0, -floor), (2 * radius, 2 * radius, 2 * scene.length), ALONG)
    scene.add("box", (0, 0, -WALL / 2), (2 * scene.length, 2 * radius, WALL))
    along: Symmetry = slide(1)
    turn = about(UP, (0, 0, 0))
    if rng.random() < 0.35:
        period, shift, out = rng.uniform(4, 12), rng.random(), rng.uniform(0.15, 0.5)
        number = int(scene.length / period)
        for x in period * (np.arange(-number, number + 1) + shift):
            scene.add("box", (x, 0, radius - floor - out / 2), (1.0, 0.5, out))
        along, turn = repeat(period), about(UP, (period * shift, 0, 0))
    edge = np.sqrt(radius**2 - floor**2)
    turns: tuple[Symmetry, ...] = (turn,)
    if rng.random() < 0.5:  # a pavement on one side
        scene.add("box", (0, edge - 0.4, 0.1), (2 * scene.length, 0.8, 0.3))
        turns = ()
    span = min(25.0, scene.reach)
    count = how_many(rng)
    scatter(scene, rng, count // 2, 0.55 * edge, 0.9 * edge, span)
    for x in rng.uniform(-span, span, count - count // 2):  # fans, signs and cabinets on the bore
        angle = rng.choice([-1, 1]) * rng.uniform(0.5, 1.4)
        size = rng.uniform((0.4, 0.3, 0.3), (2.5, 0.9, 0.9))
        out = radius - 0.4 * size[2]
        centre = (x, out * np.sin(angle), out * np.cos(angle) - floor)
        axes = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
        scene.add("box", centre, size, axes, scene.another())
    scene.symmetries = along, *turns
    return scene


def road(rng: np.random.Generator) -> Scene:
    """Level ground between guard rails or concrete barriers, on posts at even steps or without."""
    half = rng.uniform(3, 9)
    places = apart(rng, 1, 30, 0.5 * half, (0.5, 2.4))
    scene = Scene(rng.uniform(35, 90), places, (), ("spinning", "terrestrial", "rosette"), ground=Ground.flat())
    length, concrete = 2 * scene.length, rng.random() < 0.4
    top, thick = rng.uniform(0.6, 0.9), rng.uniform(0.05, 0.15)
    both = rng.random() < 0.7
    sides = (-1, 1) if both else (int(rng.choice([-1, 1])),)
    for side in sides:
        if concrete:
            scene.add("box", (0, side * half, top / 2), (length, 0.4, top))
        else:
            scene.add("box", (0, side * half, top - 0.15), (length, thick, 0.3))
    along, turn = slide(1), about(UP, (0, 0, 0))
    if not concrete and rng.random() < 0.5:
        period, shift = rng.uniform(2, 4), rng.random()
        number = int(scene.length / period)
        for x in period * (np.arange(-number, number + 1) + shift):
            for side in sides:
                scene.add("box", (x, side * (half + 0.12), top / 2), (0.12, 0.12, top))
        along, turn = repeat(period), about(UP, (period * shift, 0, 0))
    scene.symmetries = (along, turn) if both else (along,)
    scatter(scene, rng, how_many(rng), half + 0.6, half + 8, min(35.0, scene.reach))
    return scene


def open_field(rng: np.random.Generator) -> Scene:
    """Level ground, with objects far and wide; or hills."""
    places = apart(rng, 1, 30, 4, (0.5, 2.4))
    scene = Scene(rng.uniform(35, 90), places, (), ("spinning", "terrestrial", "rosette"), needed=2)
    if rng.random() < 0.25:
        return _hills(scene, rng)
    scene.ground = Ground.flat()
    scene.symmetries = slide(1), slide(0, 1), about(UP, (0, 0, 0), None)
    scatter(scene, rng, 2 * how_many(rng), 2, 25, 25)
    return scene


def _hills(scene: Scene, rng: np.random.Generator) -> Scene:
    """Relief of some decimetres, waves of 8 to 40 m: it fixes the place, whatever stands on it."""
    wave = 2 * np.pi / rng.uniform(8, 40, 7)
    heading = rng.uniform(0, 2 * np.pi, 7)
    frequency = wave[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    scene.ground = Ground(rng.uniform(0.8, 2.0) / (20 * wave), frequency, rng.uniform(0, 2 * np.pi, 7))
    scatter(scene, rng, how_many(rng), 2, 25, 25)
    scene.places[:, 2] += scene.ground.height(scene.places[:, 0], scene.places[:, 1])
    return scene


def stairwell(rng: np.random.Generator) -> Scene:
    """A flight between two walls under a slanting ceiling: every step is the next one."""
    run, rise, half = rng.uniform(0.25, 0.34), rng.uniform(0.14, 0.2), rng.uniform(0.6, 1.6)
    places = apart(rng, 0.8, 5, 0.3 * half, (1.0, 1.6))
    places[:, 2] += places[:, 0] * rise / run
    scene = Scene(rng.uniform(6, 10), places, (), ("spinning", "terrestrial", "camera"))
    number = int(scene.length / run) + 1
    for n in range(-number, number + 1):
        scene.add("box", (n * run, 0, n * rise - 0.5), (run, 2 * half, 1.0))
    slope = np.arctan2(rise, run)
    axes = np.array([[np.cos(slope), 0, -np.sin(slope)], [0, 1, 0], [np.sin(slope), 0, np.cos(slope)]])
    length, height = 2.4 * scene.length, rng.uniform(2.3, 3.2)
    scene.add("box", (0, 0, height), (length, 2 * half, WALL), axes)
    for side in (-1, 1):
        scene.add("box", (0, side * (half + WALL / 2), 0), (length, WALL, length))
    if rng.random() < 0.6:  # a handrail
        scene.add("cylinder", (0, rng.choice([-1, 1]) * (half - 0.08), 0.95), (0.05, 0.05, length), axes @ ALONG)
    for x in rng.uniform(-5, 5, how_many(rng)):
        low, side = x * rise / run, int(rng.choice([-1, 1]))
        size = rng.uniform((0.2, 0.05, 0.3), (0.9, 0.3, 1.8))
        z = low + rng.uniform(0.3, 0.6) + size[2] / 2
        scene.add("box", (x, side * (half - size[1] / 2), z), size, label=scene.another())
    scene.symmetries = (repeat(run, 0, rise),)
    return scene


def room(rng: np.random.Generator) -> Scene:
    """Four walls, and furniture."""
    length, height = rng.uniform(3.5, 12), rng.uniform(2.3, 4)
    width = length * rng.uniform(0.4, 0.85)
    size = np.array([length, width, height])
    places = rng.uniform((-0.35, -0.35, 0.25), (0.35, 0.35, 0.7), (2, 3)) * size
    scene = Scene(30, places, half_turns(height), ("spinning", "terrestrial", "camera"))
    for axis in range(3):
        for side in (-1, 1):
            centre, lengths = np.array([0, 0, height / 2]), size + 2 * WALL
            centre[axis] += side * (size[axis] + WALL) / 2
            lengths[axis] = WALL
            scene.add("box", centre, lengths)
    for _ in range(how_many(rng)):
        label, kind = scene.another(), rng.random()
        lengths = rng.uniform((0.25, 0.25, 0.3), (1.6, 0.9, 1.9))
        if kind < 0.5:  # against a wall
            side = int(rng.choice([-1, 1]))
            y, x = side * (width - lengths[1]) / 2, rng.uniform(-0.4, 0.4) * length
            scene.add("box", (x, y, lengths[2] / 2), lengths, label=label)
            continue
        x, y = rng.uniform(-0.4, 0.4, 2) * (length, width)
        if kind < 0.8:  # a table: its top on one leg
            scene.add("box", (x, y, 0.72), (lengths[0], lengths[1], 0.05), yawed(rng.uniform(0, np.pi)), label)
            scene.add("cylinder", (x, y, 0.35), (0.15, 0.15, 0.7), label=label)
        else:
            scene.add("ellipsoid", (x, y, lengths[1] / 2), lengths[[0, 1, 1]], yawed(rng.uniform(0, np.pi)), label)
    return scene


def parking(rng: np.random.Generator) -> Scene:
    """One or two rows of cars alike at even steps; or cars of many kinds, with gaps."""
    half, period = rng.uniform(3, 5), rng.uniform(2.4, 3)
    places = apart(rng, 1, 20, 0.4 * half, (0.5, 2.2))
    scene = Scene(rng.uniform(20, 40), places, (), ("spinning", "terrestrial", "rosette"), ground=Ground.flat())
    size, shift, both = car_size(rng), rng.random(), rng.random() < 0.6
    count, number = how_many(rng), int(scene.length / period)
    odd = set(rng.choice(np.arange(-8, 9), min(count, 17), replace=False).tolist())
    for n in range(-number, number + 1):
        for side in (-1, 1) if both else (1,):
            if n in odd and rng.random() < 0.7:  # another kind of car, which stands where it can be seen to be one
                other = car_size(rng) * (1, 1, rng.uniform(1.1, 1.5))
                shifted = side * (half + 2.5 - rng.uniform(0.3, 0.8))
                car(scene, period * (n + shift), shifted, side * np.pi / 2, other, scene.another())
            else:
                car(scene, period * (n + shift), side * (half + 2.5), side * np.pi / 2, size)
    turn = about(UP, (period * shift, 0, 0))
    scene.symmetries = (repeat(period), turn) if both else (repeat(period),)
    return scene


def street(rng: np.random.Generator) -> Scene:
    """House fronts on both sides, all alike or each its own, with cars and lamp posts before them."""
    half = rng.uniform(4, 10)
    places = apart(rng, 2, 25, 0.4 * half, (0.5, 2.2))
    scene = Scene(rng.uniform(30, 70), places, (), ("spinning", "terrestrial", "rosette"), ground=Ground.flat())
    alike, period, shift = rng.random() < 0.4, rng.uniform(4, 9), rng.random()
    count = how_many(rng)
    if not alike:
        for side in (-1, 1):
            _houses(scene, rng, side, half)
        scatter(scene, rng, count, half - 2.5, half - 0.5, 25)
        return scene
    depth, height, door = rng.uniform(0.2, 1.2), rng.uniform(4, 10), rng.uniform(-0.3, 0.3) * period
    wide = rng.uniform(0.3, 0.5) * period
    number = int(scene.length / period)
    for side in (-1, 1):
        scene.add("box", (0, side * (half + 2), height / 2), (2 * scene.length, 4, height))
        for x in period * (np.arange(-number, number + 1) + side * shift):
            scene.add("box", (x, side * half, height / 2), (wide, 2 * depth, 0.9 * height))
            scene.add("box", (x + side * door, side * (half - depth), 1.0), (1.1, 0.3, 2.0))
    scene.symmetries = repeat(period), about(UP, (0, 0, 0))
    scatter(scene, rng, count, half - depth - 2.0, half - depth - 0.5, 25)
    return scene


def _houses(scene: Scene, rng: np.random.Generator, side: int, half: float) -> None:
    """A row of houses of many widths and heights, some back from the street, with bays and gaps: each an object."""
    x = -scene.length
    while x < scene.length:
        width, height, back = rng.uniform(4, 14), rng.uniform(3, 12), rng.uniform(0, 2.5)
        label = scene.another()
        scene.add("box", (x + width / 2, side * (half + back + 4), height / 2), (width, 8, height), label=label)
        for _ in range(rng.integers(3)):
            size = rng.uniform((0.8, 0.3, 1.0), (2.5, 1.2, 0.8 * height))
            at = x + rng.uniform(0.2, 0.8) * width
            scene.add("box", (at, side * (half + back), size[2] / 2), size, label=label)
        x += width + rng.choice([0.0, rng.uniform(1, 6)])


def forest(rng: np.random.Generator) -> Scene:
    """Trunks anywhere on rough ground; or a plantation's, all alike in rows on level ground."""
    places = apart(rng, 1, 12, 1, (0.8, 2.0))
    scene = Scene(rng.uniform(15, 30), places, (), ("spinning", "terrestrial", "rosette"), ground=Ground.flat())
    if rng.random() < 0.25:
        step, width = rng.uniform(2.5, 5, 2), rng.uniform(0.15, 0.4)
        across, along = (int(scene.length / s) + 1 for s in (step[1], step[0]))
        for n in range(-along, along):
            for m in range(-across, across):
                scene.add("cylinder", ((n + 0.5) * step[0], (m + 0.5) * step[1], 4), (width, width, 8))
        scene.symmetries = repeat(step[0]), repeat(0, step[1]), about(UP, (0, 0, 0))
        scatter(scene, rng, how_many(rng), 1.0, 6, 8)
        return scene
    scene = _hills(scene, rng)
    for _ in range(int(rng.uniform(0.01, 0.05) * (2 * scene.reach) ** 2)):
        x, y = rng.uniform(-scene.reach, scene.reach, 2)
        width, lean = np.exp(rng.uniform(np.log(0.1), np.log(0.6))), rng.normal(scale=0.06, size=2)
        z = float(scene.ground.height(x, y)) if scene.ground is not None else 0.0
        axes = np.linalg.qr(np.array([[lean[0], 1, 0], [lean[1], 0, 1], [1, 0, 0.0]]))[0][:, [1, 2, 0]]
        axes *= np.sign(axes[2, 2])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        scene.add("cylinder", (x, y, z + 3), (width, width, 8), axes, scene.another())
        if rng.random() < 0.25:
            crown = rng.uniform((1, 1, 0.6), (2.5, 2.5, 2.5))
            scene.add("ellipsoid", (x, y, z + rng.uniform(3, 7)), crown, label=scene.objects - 1)
    return scene


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "corridor": corridor,
    "pillars": pillars,
    "tunnel": tunnel,
    "road": road,
    "field": open_field,
    "stairwell": stairwell,
    "room": room,
    "parking": parking,
    "street": street,
    "forest": forest,
}
"""The families of scenes."""
