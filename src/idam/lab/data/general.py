"""Pairs of scans as practice has them: any rotation, other points, partial views, noise, strays; drawn without end.

Where the paper's protocol crops two copies of the same points, here each scan samples the surface anew: an object seen
from a few viewpoints, a room, a street as a spinning LiDAR sees it, or half of a ModelNet40 shape's points; and half of
the pairs are ray-cast (:mod:`idam.lab.data.sensor_pairs`), with the sensors' own patterns in them. All go through the
same centring, scaling and voxel grid as in :func:`idam.register`, so that a network sees in training what it sees in
use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from idam import rigid
from idam.errors import InputError
from idam.io.files import one_line, silenced
from idam.lab.data.own_pairs import OwnPair
from idam.lab.data.practice import make_practice_pairs
from idam.lab.data.sensor_pairs import draw_part_in_whole, draw_sensor_pair
from idam.lab.data.surfaces import random_object, random_room, random_street
from idam.lab.data.visibility import seen_from_afar, seen_from_within
from idam.lab.data.working import ScanPair, as_registered

__all__ = ["Material", "draw_halves", "draw_scans", "load_meshes"]

Points = NDArray[np.float64]
Draw = Callable[["Material", np.random.Generator], "tuple[Points, Points] | None"]

DENSE = 60_000
"""Points of an object before it is scanned; rooms and streets have twice as many."""
FEWEST = 120
"""Points of each scan at least."""
COUNTS, SHARES = (600, 1000, 1500, 2000), (0.1, 0.25, 0.35, 0.3)
"""Points of the larger scan, about, and how often each number is drawn."""
NOISE, MUCH_NOISE = 0.008, 0.02
"""Largest sigmas, in an object's radii, of most pairs and of every fifth."""
STRAYS = 0.006
"""Largest share of points that are strays, in every third scan."""
LEAST_OVERLAP, MORE_OVERLAP = 0.05, 0.2
"""A pair is drawn again where it overlaps less than a share drawn from between these."""
OWN = 0.5
"""Share of pairs that are one's own scans, where there are any: the rest keeps what other scenes have taught."""
RANGE = 2.2
"""How far a street's LiDAR sees."""
SENSED, IN_WHOLE = 0.5, 0.2
"""Share of pairs that are ray-cast as real sensors see, and of those, views of a part against the whole."""


@dataclass(frozen=True)
class Material:
    """What scans are made of, besides our own surfaces.

    Attributes:
        shapes: of ModelNet40, (S, N, 3).
        meshes: of trimesh.
        pairs: real scans with their true transforms.
    """

    shapes: NDArray[np.float32]
    meshes: Sequence[Any] = ()
    pairs: Sequence[OwnPair] = ()


def load_meshes(folder: Path) -> list[Any]:
    """The triangle meshes (``.ply``) of a folder; none where there is no such folder.

    Raises:
        InputError: one of them cannot be read, or has no surface.
    """
    return [_load_mesh(path) for path in sorted(folder.glob("*.ply"))]


def _load_mesh(path: Path) -> Any:
    import trimesh

    try:
        with silenced("trimesh"):
            mesh: Any = trimesh.load(path, process=False)
            area = float(getattr(mesh, "area", 0.0))
    except Exception as error:  # there is no telling what parsers throw at a damaged file
        raise InputError(
            f"{path}: cannot be read as a mesh ({one_line(error)}); export it again, or remove it"
        ) from None
    if not 0 < area < np.inf:
        raise InputError(f"{path}: is a mesh without area; export it with its faces, or remove it")
    return mesh


def draw_scans(material: Material, rng: np.random.Generator) -> ScanPair:
    """A pair of scans, a function of the generator's state."""
    while True:
        if material.pairs and rng.random() < OWN:
            if (own := _own_scans(material, rng)) is not None:
                return own
            continue
        pair = _as_sensed(material, rng) if rng.random() < SENSED else _of_dense_points(material, rng)
        if pair is not None and pair.overlap >= rng.uniform(LEAST_OVERLAP, MORE_OVERLAP):
            return pair


def _as_sensed(material: Material, rng: np.random.Generator) -> ScanPair | None:
    """A pair with the patterns of real sensors in it, in any rotation; None where too few points are left."""
    inside = rng.random() < IN_WHOLE
    pair = draw_part_in_whole(rng, material.meshes) if inside else draw_sensor_pair(rng)
    turned = rigid.transform(Rotation.random(random_state=rng).as_matrix(), np.zeros(3))
    return _in_working_coordinates(
        pair.source, rigid.apply(turned, pair.target), turned @ pair.transformation, int(rng.choice(COUNTS, p=SHARES))
    )


def _of_dense_points(material: Material, rng: np.random.Generator) -> ScanPair | None:
    """A pair that samples a surface of dense points evenly; None where there is too little of it."""
    kinds: list[Draw] = [_halves, _views_of_an_object, _views_of_a_room, _views_of_a_street]
    drawn = kinds[rng.choice(len(kinds), p=(0.2, 0.45, 0.2, 0.15))](material, rng)
    return None if drawn is None else _as_scanned(*drawn, rng)


def draw_halves(material: Material, rng: np.random.Generator) -> ScanPair:
    """A pair of the practice protocol (:func:`idam.lab.data.practice.make_practice_pairs`), in any rotation."""
    shape = torch.from_numpy(material.shapes[rng.integers(len(material.shapes))])[None]
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pair = make_practice_pairs(shape, generator, math.pi)
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = pair.rotation[0].numpy(), pair.translation[0].numpy()
    scans = _in_working_coordinates(
        pair.source[0].double().numpy(), pair.target[0].double().numpy(), truth, max(COUNTS)
    )
    assert scans is not None  # no voxel grid leaves fewer of so few points
    return scans


def _own_scans(material: Material, rng: np.random.Generator) -> ScanPair | None:
    """A pair of real scans in another pose, at some resolution; None where too few points are left."""
    pair = material.pairs[int(rng.integers(len(material.pairs)))].located(always=True)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    count = int(rng.choice(COUNTS, p=SHARES))
    return _in_working_coordinates(pair.source @ turn[:3, :3].T, pair.target, pair.transformation @ turn.T, count)


def _halves(material: Material, rng: np.random.Generator) -> tuple[Points, Points] | None:
    """Disjoint halves of a shape's points, each cropped by a half-space; None where there are no shapes."""
    if len(material.shapes) == 0:
        return None
    points = material.shapes[rng.integers(len(material.shapes))].astype(np.float64)
    points = points[rng.permutation(len(points))]
    first, second = np.array_split(points, 2)
    return first[_below(first, 0.55, rng)], second[_below(second, 0.55, rng)]


def _views_of_an_object(material: Material, rng: np.random.Generator) -> tuple[Points, Points] | None:
    """An object from all around, or seen from one or three viewpoints, those of the scans 10 to 130 degrees apart."""
    points = random_object(DENSE, rng, material.meshes) @ Rotation.random(random_state=rng).as_matrix().T
    axis = rng.normal(size=3)
    apart = np.radians(rng.uniform(10, 130)) * axis / np.linalg.norm(axis)
    first = Rotation.random(random_state=rng)
    masks = []
    around = rng.random() < 0.25
    for side in (first, first * Rotation.from_rotvec(apart)):
        if around:
            masks.append(_below(points, 0.4, rng))
            continue
        number = rng.choice([1, 3], p=[0.7, 0.3])
        views = [side * Rotation.from_rotvec(0.25 * rng.normal(size=3)) for _ in range(number)]
        seen = np.any([seen_from_afar(points, view.as_matrix(), int(rng.integers(60, 110))) for view in views], 0)
        masks.append(seen & _below(points, 0.5, rng) if rng.random() < 0.4 else seen)
    return _sampled_apart(points, masks, rng)


def _views_of_a_room(material: Material, rng: np.random.Generator) -> tuple[Points, Points] | None:
    """A room as a camera with a wide field of view sees it from one to three places."""
    points, places = random_room(2 * DENSE, rng, material.meshes)
    masks = []
    for _ in range(2):
        seen = np.zeros(len(points), bool)
        for place in rng.permutation(places)[: rng.integers(1, 4)]:
            look = rng.normal(size=3) * (1, 1, 0.4)
            ray = points - place
            ahead = ray @ look / (np.linalg.norm(ray, axis=1) * np.linalg.norm(look))
            seen |= seen_from_within(points, place) & (ahead > np.cos(np.radians(rng.uniform(40, 90))))
        masks.append(seen)
    return _sampled_apart(points, masks, rng)


def _views_of_a_street(_: Material, rng: np.random.Generator) -> tuple[Points, Points] | None:
    """A street as a spinning LiDAR sees it from two places: the farther, the sparser."""
    points, places = random_street(2 * DENSE, rng)
    first = int(rng.integers(len(places) - 2))
    masks = []
    for place in places[[first, first + int(rng.integers(1, 3))]]:
        ray = points - place
        distance = np.linalg.norm(ray, axis=1)
        within = (distance < RANGE) & (ray[:, 2] < 0.25 * distance)
        masks.append(seen_from_within(points, place) & within & (rng.random(len(points)) < 0.5 / distance**2))
    return _sampled_apart(points, masks, rng)


def _below(points: Points, least: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which points (N, 3) a random half-space keeps: a share of ``least`` or more."""
    along = points @ rng.normal(size=3)
    kept: NDArray[np.bool_] = along <= np.quantile(along, rng.uniform(least, 1))
    return kept


def _sampled_apart(
    points: Points, masks: list[NDArray[np.bool_]], rng: np.random.Generator
) -> tuple[Points, Points] | None:
    """Two scans of dense points (N, 3) by what each sees; no point is in both. None where they see too little."""
    first = rng.random(len(points)) < 0.5
    source, target = points[masks[0] & first], points[masks[1] & ~first]
    if min(len(source), len(target)) < 10 * FEWEST:
        return None
    if rng.random() < 0.3:
        source = source[rng.random(len(source)) < rng.uniform(0.3, 1)]
    return source, target


def _as_scanned(source: Points, target: Points, rng: np.random.Generator) -> ScanPair | None:
    """Turned, with noise and strays, and as :func:`idam.register` sees them; None where too few points are left."""
    sigma = rng.uniform(0, NOISE if rng.random() < 0.8 else MUCH_NOISE)
    truth = np.eye(4)
    truth[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    clouds = []
    for cloud in (source, target):
        noisy = cloud + sigma * rng.normal(size=cloud.shape)
        stray = rng.random(len(noisy)) < (rng.uniform(0, STRAYS) if rng.random() < 0.3 else 0.0)
        noisy[stray] += 0.3 * rng.normal(size=(stray.sum(), 3))
        clouds.append(noisy)
    source, target = clouds[0], clouds[1] @ truth[:3, :3].T
    return _in_working_coordinates(source, target, truth, int(rng.choice(COUNTS, p=SHARES)))


def _in_working_coordinates(source: Points, target: Points, truth: Points, count: int) -> ScanPair | None:
    """Clouds and the truth (4, 4) as :func:`idam.register` sees them; None where too few points are left."""
    if min(len(source), len(target)) < FEWEST:
        return None
    pair = as_registered(source, target, truth, count)
    return pair if min(len(pair.source), len(pair.target)) >= FEWEST else None
