"""One cloud with all that depends on it alone: where it is, its levels of resolution, their surfaces and features."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from idam.clouds.frame import check_points, without_strays
from idam.clouds.surfaces import Surface, spacing_of
from idam.clouds.viewpoint import seen_from
from idam.clouds.voxels import downsample, ladder, rung, rung_for
from idam.describe.invariant import Descriptor, surroundings
from idam.errors import InputError
from idam.io.files import write_bytes
from idam.rigid import Array

__all__ = ["ALL", "FINE", "LARGER", "SMALL", "SPARSE", "Level", "Prepared"]

SPARSE = 1024
"""Points of the larger cloud up to which all are matched, and aligned as sparse clouds are."""
SMALL = 640
"""Points of the larger cloud that are matched first, where there are more."""
LARGER = 2000
"""Points of the larger cloud that are matched where the small clouds do not settle the matter."""
FINE = 10_000
"""Points of the larger cloud that the last refinement uses."""
FORMAT = 2
"""Of saved clouds: changes when they can no longer be read, or would give other answers."""
BASE = 100_000
"""Points that are kept of a cloud, besides those given: all levels are thinned from them."""
FINER = 2.0
"""Voxel sizes of the fine level from which on others are thinned from it."""
ALL = 0.0
"""The voxel size that stands for no voxel grid at all."""


@dataclass(eq=False)
class Level:
    """A cloud at one resolution.

    Attributes:
        points: (N, 3), relative to the cloud's centre, in input units.
        voxel_size: of the grid that thinned it, in input units, or :data:`ALL`.
        features: what descriptors made of the points, by the descriptor's key and the rung of the spacing.
    """

    points: Array
    voxel_size: float
    features: dict[tuple[str, int], NDArray[np.float32]] = field(default_factory=dict, repr=False)
    _surfaces: dict[float, Surface] = field(default_factory=dict, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: small_gicp's surfaces do not, and are made anew there."""
        return {**self.__dict__, "_surfaces": {}}

    @cached_property
    def spacing(self) -> float:
        """The median distance of neighbouring points, in input units."""
        return spacing_of(self.points)

    @property
    def spacing_rung(self) -> int:
        """The rung of the spacing."""
        return rung(self.spacing)

    def surface(self, unit: float) -> Surface:
        """The surface, in units of so many input units (a power of two, so that nothing is rounded)."""
        if unit not in self._surfaces:
            self._surfaces[unit] = Surface.of(self.points / unit)
        return self._surfaces[unit]

    def described(self, descriptor: Descriptor, spacing: int) -> NDArray[np.float32]:
        """Features (N, K) of the points, at a spacing of that rung."""
        key = descriptor.key, spacing
        if key not in self.features:
            self.features[key] = descriptor.describe(surroundings(self.points, ladder(spacing)))
        return self.features[key]


@dataclass(eq=False)
class Prepared:
    """A cloud ready to be registered with any other: what depends on it alone is worked out once.

    Pass it to :func:`idam.register` wherever a cloud is taken; the answer is the same to the last bit.

    Attributes:
        points: (N, 3), as given.
        name: what messages call it.
        centre: of the cloud without strays, (3,).
        radius: around the centre, in input units.
        levels: the resolutions that were asked for so far, by voxel size.
    """

    points: Array
    name: str
    centre: Array
    radius: float
    levels: dict[float, Level] = field(default_factory=dict, repr=False)
    _rungs: dict[int, int | None] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, points: Array, name: str) -> Prepared:
        """From points (N, 3).

        Raises:
            InputError: they cannot be registered (:func:`idam.clouds.frame.check_points`).
        """
        return cls(points, name, *check_points(points, name))

    @property
    def unit(self) -> float:
        """The power of two nearest to the radius: the working unit of two clouds of this size."""
        return float(2.0 ** round(math.log2(self.radius)))

    @cached_property
    def base(self) -> Array:
        """The points that all levels are thinned from, :data:`BASE` at most, (N, 3), relative to the centre."""
        points = self._centred()
        step = rung_for(points, BASE, self.radius)
        return points if step is None else downsample(points, ladder(step))

    @cached_property
    def eye(self) -> Array | None:
        """Where the scan was taken from, (3,), relative to the centre: its frame's origin; None for no single scan."""
        points, origin = self._centred(), -self.centre
        surface, unit = self.level(self.voxel_size(FINE)).surface(self.unit), self.unit
        return origin if seen_from(points[:: len(points) // BASE + 1] / unit, surface, origin / unit) else None

    def voxel_size(self, count: int) -> float:
        """The voxel size of the ladder that leaves at most ``count`` points, :data:`ALL` where there are no more."""
        if count not in self._rungs:
            self._rungs[count] = rung_for(self.base, count, self.radius)
        step = self._rungs[count]
        return ALL if step is None else ladder(step)

    def level(self, voxel_size: float) -> Level:
        """The cloud on a voxel grid."""
        if voxel_size not in self.levels:
            if voxel_size == ALL:  # a voxel grid merges copies of a point, too
                thinned = np.unique(self.base, axis=0)
            else:
                thinned = downsample(self.finer(voxel_size), voxel_size)
            self.levels[voxel_size] = Level(thinned, voxel_size)
        return self.levels[voxel_size]

    def finer(self, voxel_size: float) -> Array:
        """What a level is thinned from: the cloud's own fine level where that is fine enough, or else all."""
        own = self.voxel_size(FINE)
        return self.level(own).points if ALL < FINER * own <= voxel_size else self.base

    def every(self, most: int) -> Array:
        """Points (N, 3) relative to the centre, in input units: every n-th, so that ``most`` at most are left.

        What a voxel grid does not do: leave the noise of the points as it is.
        """
        points = self._centred()
        return np.ascontiguousarray(points[:: -(-len(points) // most)])

    def _centred(self) -> Array:
        """The points (N, 3) relative to the centre, in input units, without strays."""
        return without_strays(self.points - self.centre, self.radius)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the cloud with all that was worked out so far, atomically; :meth:`load` reads it.

        Raises:
            InputError: the file cannot be written.
        """
        arrays: dict[str, NDArray[Any]] = {"points": self.points, "centre": self.centre}
        sizes = sorted(self.levels)
        for number, size in enumerate(sizes):
            level = self.levels[size]
            arrays[f"{number}.points"] = level.points
            arrays |= {f"{number}.{key}.{step}": features for (key, step), features in level.features.items()}
        arrays = {key: np.ascontiguousarray(x) for key, x in arrays.items()}
        about = json.dumps({"format": FORMAT, "name": self.name, "radius": self.radius, "sizes": sizes})
        write_bytes(path, save(arrays, {"idam": about, "sha256": _digest(about, arrays)}))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Prepared:
        """Read what :meth:`save` wrote.

        Raises:
            InputError: the file cannot be read, or is something else.
        """
        try:
            with safe_open(path, "np") as file:
                metadata = file.metadata()
                about = json.loads(metadata["idam"])
                if about["format"] != FORMAT:
                    raise ValueError("another version of idam wrote it")
                arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
                if metadata["sha256"] != _digest(metadata["idam"], arrays):
                    raise ValueError("its content has changed")
            cloud = cls(arrays.pop("points"), about["name"], arrays.pop("centre"), float(about["radius"]))
            for number, size in enumerate(about["sizes"]):
                level = cloud.levels[size] = Level(arrays.pop(f"{number}.points"), size)
                for name in [name for name in arrays if name.startswith(f"{number}.")]:
                    _, key, step = name.split(".")
                    level.features[key, int(step)] = arrays[name]
        except (SafetensorError, OSError, KeyError, TypeError, ValueError, IndexError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
            raise InputError(f"{path}: not a prepared cloud ({reason}); make it anew with idam.prepare") from None
        return cloud


def _digest(about: str, arrays: dict[str, NDArray[Any]]) -> str:
    """What tells a file as it was written from one that was damaged since: nothing else of it need be doubted."""
    digest = hashlib.sha256(about.encode())
    for key in sorted(arrays):
        array = arrays[key]
        digest.update(f"{key} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()
