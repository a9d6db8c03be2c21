"""Pairs of one's own, of any sizes and anywhere: an ``.npz`` of arrays, or a JSON list of files."""

from __future__ import annotations

import json
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.errors import InputError
from idam.io import read_point_cloud, rigid_fault
from idam.io.files import one_line

__all__ = ["LocatedPairs", "OwnPair", "OwnPairs", "read_own_pairs"]

Points = NDArray[np.float64]

FAR = 100.0
"""A cloud that lies so many times its own size off the origin is moved there before it becomes float32, whose spacing
at that distance is a hundred thousandth of the cloud; nearer ones stay where they are, as networks were trained."""


@dataclass(frozen=True)
class LocatedPairs:
    """n pairs near the origin, of any sizes, with the members of :class:`idam.lab.data.pairs.Pairs`.

    Attributes:
        source: clouds (P, 3), float32.
        target: clouds (Q, 3), float32.
        rotation: the truth, target = R source + t between these: (n, 3, 3), float64.
        translation: (n, 3), float64.
    """

    source: list[Tensor]
    target: list[Tensor]
    rotation: Tensor
    translation: Tensor

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: slice) -> LocatedPairs:
        return LocatedPairs(self.source[index], self.target[index], self.rotation[index], self.translation[index])


@dataclass(frozen=True)
class OwnPair:
    """A pair as it was given.

    Attributes:
        source: (P, 3).
        target: (Q, 3).
        transformation: the truth (4, 4), target = T source.
    """

    source: Points
    target: Points
    transformation: Points

    def located(self, *, always: bool) -> OwnPair:
        """With the centroid of each cloud moved to the origin: where it lies far off, or always."""
        source, target = (origin(cloud, always=always) for cloud in (self.source, self.target))
        truth = self.transformation.copy()
        truth[:3, 3] += truth[:3, :3] @ source - target
        return OwnPair(self.source - source, self.target - target, truth)


@dataclass(frozen=True)
class OwnPairs:
    """The pairs of a file.

    Attributes:
        pairs: one or more.
        within: degrees and distance up to which an answer counts as right, where the file says so.
        scans: whether they are scans in files, whose translation errors are measured at the source's centroid.
    """

    pairs: list[OwnPair]
    within: tuple[float, float] | None = None
    scans: bool = False

    def located(self) -> LocatedPairs:
        """All of them near the origin, where float32 holds them."""
        pairs = [pair.located(always=self.scans) for pair in self.pairs]
        truth = torch.from_numpy(np.stack([pair.transformation for pair in pairs]))
        return LocatedPairs(
            [torch.from_numpy(pair.source).float() for pair in pairs],
            [torch.from_numpy(pair.target).float() for pair in pairs],
            truth[:, :3, :3],
            truth[:, :3, 3],
        )


def origin(cloud: Points, *, always: bool) -> Points:
    """What a cloud's own origin is: its centroid, or nothing where it lies near enough and need not move."""
    centroid: Points = cloud.mean(0)
    size = np.ptp(cloud, axis=0).max()
    return centroid if always or np.abs(centroid).max() > FAR * size else np.zeros(3)


def read_own_pairs(path: str | Path) -> OwnPairs:
    """Pairs with their true transforms.

    An ``.npz`` has ``source`` (n, P, 3), ``target`` (n, Q, 3), ``R`` (n, 3, 3) and ``t`` (n, 3), target = R source + t;
    clouds of unequal size are object arrays of n arrays. A ``.json`` file is a list of objects with ``source`` and
    ``target``, files relative to its folder, and ``transformation``, 4 rows of 4; or an object with that list as
    ``pairs``, and ``success`` with ``rotation_deg`` and ``centroid_shift``, where recall is to have other bounds.

    Raises:
        InputError: the file is missing, or not of that form.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an .npz or a .json of pairs")
    return _listed(path) if path.suffix.lower() == ".json" else OwnPairs(_in_arrays(path))


# arrays


def _in_arrays(path: Path) -> list[OwnPair]:
    source, target, rotation, translation = _arrays(path)
    sources, targets = _clouds(path, "source", source), _clouds(path, "target", target)
    count = len(sources)
    _check_shape(path, "target", target, (count, *target.shape[1:]))
    _check_shape(path, "R", rotation, (count, 3, 3))
    _check_shape(path, "t", translation, (count, 3))
    for name, array in (("R", rotation), ("t", translation)):
        _check_finite(path, name, array)
    if np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation).min() < 0:
        raise InputError(f"{path}: R holds matrices that are no rotations; needed are orthogonal ones, determinant 1")
    transformation = np.tile(np.eye(4), (count, 1, 1))
    transformation[:, :3, :3], transformation[:, :3, 3] = rotation, translation
    return [OwnPair(*pair) for pair in zip(sources, targets, transformation, strict=True)]


def _arrays(path: Path) -> list[NDArray[Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            clouds = [_array(archive, f"{key}.npy", objects=True) for key in ("source", "target")]
            return [*clouds, *(_array(archive, f"{key}.npy") for key in ("R", "t"))]
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]}; it needs the arrays source, target, R and t") from None
    except Exception as error:  # there is no telling what parsers throw at a damaged file
        raise InputError(f"{path}: cannot be read as .npz ({one_line(error)})") from None


def _array(archive: zipfile.ZipFile, name: str, *, objects: bool = False) -> NDArray[Any]:
    with archive.open(name) as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        if dtype.hasobject and objects:
            return np.asarray(_ArraysAlone(stream).load(), object).reshape(shape)
    with archive.open(name) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False), np.float64)


class _ArraysAlone(pickle.Unpickler):
    """Reads pickles of NumPy's arrays, and of nothing else: any other could run code of whoever wrote it."""

    def find_class(self, module: str, name: str) -> Any:
        """What arrays are rebuilt by, under NumPy 1's and NumPy 2's names."""
        known = ("_reconstruct", "ndarray", "dtype", "_frombuffer")
        if module.split(".")[0] != "numpy" or name not in known:
            raise pickle.UnpicklingError(f"it holds {module}.{name}, not arrays alone")
        return super().find_class(module, name)


def _clouds(path: Path, name: str, array: NDArray[Any]) -> list[Points]:
    """The clouds (n, P, 3), or those of an object array."""
    try:
        clouds = [np.asarray(cloud, np.float64) for cloud in array] if array.ndim else []
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {name} cannot be read as clouds ({one_line(error)})") from None
    if not clouds or any(cloud.ndim != 2 or cloud.shape[1] != 3 for cloud in clouds):
        raise _of_another_shape(path, name, array)
    for cloud in clouds:
        if len(cloud) < 3:
            raise InputError(f"{path}: a pair needs 3 points of each cloud or more; give larger clouds")
        _check_finite(path, name, cloud)
    return clouds


def _check_shape(path: Path, name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise _of_another_shape(path, name, array)


def _check_finite(path: Path, name: str, array: NDArray[Any]) -> None:
    """Raise InputError where numbers are NaN, infinite, or too large for float32."""
    if not np.abs(array).max() < np.finfo(np.float32).max:
        raise InputError(f"{path}: {name} holds NaN or infinite numbers")


def _of_another_shape(path: Path, name: str, array: NDArray[Any]) -> InputError:
    return InputError(
        f"{path}: {name} has shape {array.shape}; needed are (n, P, 3), (n, Q, 3), (n, 3, 3), (n, 3), and of clouds of "
        "unequal size object arrays of n arrays"
    )


# files


def _listed(path: Path) -> OwnPairs:
    try:
        content = json.loads(path.read_text())
        records = content["pairs"] if isinstance(content, dict) else content
        success = content.get("success") if isinstance(content, dict) else None
        within = None if success is None else (float(success["rotation_deg"]), float(success["centroid_shift"]))
        named = [(record["source"], record["target"], record["transformation"]) for record in records]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: is no list of pairs ({type(error).__name__}: {one_line(error)}); each needs source, target and "
            "transformation"
        ) from None
    if not named:
        raise InputError(f"{path}: lists no pairs")
    files = {name for source, target, _ in named for name in (source, target)}
    clouds = {name: read_point_cloud(path.parent / str(name)).points for name in files}
    for name, cloud in clouds.items():
        if len(cloud) < 3:
            raise InputError(f"{path.parent / name}: has {len(cloud)} points, and a pair needs 3 of each cloud or more")
    pairs = [
        OwnPair(clouds[source], clouds[target], _rigid(path, n, matrix))
        for n, (source, target, matrix) in enumerate(named, 1)
    ]
    return OwnPairs(pairs, within, scans=True)


def _rigid(path: Path, number: int, rows: Any) -> Points:
    try:
        matrix = np.asarray(rows, np.float64)
        fault = rigid_fault(matrix)
    except (TypeError, ValueError) as error:
        fault = one_line(error)
    if fault:
        raise InputError(f"{path}: transformation of pair {number}: {fault}")
    return matrix
