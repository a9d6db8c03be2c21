"""What a scene is: scenery with its symmetries, and objects that break them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from idam.lab.data.raycast import Ground, Kind, Solid

__all__ = ["ACROSS", "ALONG", "LENGTHWISE", "UP", "Scene", "Symmetry", "about", "repeat", "slide", "yawed"]

Array = NDArray[np.float64]


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
