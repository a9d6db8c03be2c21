"""How precisely a transform is known, against the scatter of repeated registrations."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.align import align, reaches
from idam.align.information import information
from idam.align.patches import Pairs
from idam.align.polish import finished, polish
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.rigid import Array

TRUTH = rigid.exp(np.array([0.4, -0.3, 0.2, 0.1, 0.2, -0.3]))


def blob(rng: np.random.Generator, count: int) -> Array:
    """Points of a sphere with dents, which nothing turns onto itself."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    middles = np.random.default_rng(5).normal(size=(12, 3))
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    height = np.random.default_rng(6).uniform(-0.3, 0.3, 12)
    return 0.8 * way * (1 + np.exp((way @ middles.T - 1) / 0.12) @ height)[:, None]


def corner(rng: np.random.Generator, count: int) -> Array:
    """Three walls with a box before one of them."""
    points = rng.uniform(-0.7, 0.7, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = -0.7
    return points


def corridor(rng: np.random.Generator, count: int) -> Array:
    """A floor and a wall: what slides along the first axis."""
    points = rng.uniform(-0.5, 0.5, (count, 3)) * [2.0, 1.0, 1.0]
    points[np.arange(count), 1 + rng.integers(0, 2, count)] = -0.5
    return points


def surfaces_of(source: Array, target: Array) -> Surfaces:
    spacing = max(spacing_of(source), spacing_of(target))
    return Surfaces(Surface.of(source), Surface.of(target), spacing)


def scanned(shape, seed: int, count: int, noise: float, share: float = 1.0) -> Surfaces:
    """Two samplings with noise, each of the share of the shape that lies lowest or highest; the target is moved."""
    rng = np.random.default_rng(seed)
    height = np.quantile(shape(np.random.default_rng(0), 4000).sum(1), [share, 1 - share])
    source, target = shape(rng, count), shape(rng, count)
    source, target = source[source.sum(1) <= height[0]], target[target.sum(1) >= height[1]]
    source, target = (points + noise * rng.normal(size=points.shape) for points in (source, target))
    return surfaces_of(source, rigid.apply(TRUTH, target))


def aligned(surfaces: Surfaces, seed: int) -> tuple[Array, Pairs]:
    start = TRUTH @ rigid.exp(np.random.default_rng(seed).normal(scale=0.003, size=6))
    if len(surfaces.source.points) <= 1024:
        start = align(surfaces, start, reaches("symmetric")[1], "symmetric")
        return finished(surfaces, lambda: (None, None), start, "symmetric", True)  # type: ignore
    return polish(surfaces, start, lambda: (surfaces.source.points, surfaces.target.points))


@pytest.mark.parametrize(
    ("shape", "count", "noise", "share"),
    [(blob, 1000, 0.0005, 0.8), (blob, 4000, 0.005, 0.7), (corner, 1000, 0.002, 1.0), (corner, 4000, 0.005, 0.8)],
)
def test_errors_of_repeated_registrations_are_what_the_information_says(shape, count, noise, share) -> None:
    squares = []
    for seed in range(12):
        transformation, pairs = aligned(scanned(shape, seed, count, noise, share), seed)
        error = rigid.log(rigid.inverse(transformation) @ TRUTH)
        squares.append(error @ information(pairs) @ error)
    assert 3 < np.mean(squares) < 12  # six unknowns


def test_copies_with_noise_are_known_as_well_as_the_information_says() -> None:
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = blob(rng, 600)
        noise = rng.normal(scale=0.005, size=points.shape)
        surfaces = surfaces_of(points, rigid.apply(TRUTH, points + noise))
        # the least squares fit of copies, in closed form
        source, target = points - points.mean(0), surfaces.target.points - surfaces.target.points.mean(0)
        u, _, vh = np.linalg.svd(target.T @ source)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
        start = rigid.transform(rotation, surfaces.target.points.mean(0) - rotation @ points.mean(0))
        transformation, pairs = finished(surfaces, lambda: (None, None), start, "symmetric", True)  # type: ignore
        error = rigid.log(rigid.inverse(transformation) @ TRUTH)
        squares.append(error @ information(pairs) @ error)
    assert 3 < np.mean(squares) < 12


def test_what_slides_is_not_known() -> None:
    _, pairs = aligned(scanned(corridor, 0, 4000, 0.003), 0)
    matrix = information(pairs)
    along = np.array([0, 0, 0, 1.0, 0, 0])
    across = np.array([0, 0, 0, 0, 1.0, 0])
    assert along @ matrix @ along < 1e-3 * (across @ matrix @ across)
    assert np.linalg.eigvalsh(matrix).min() >= 0.99


def test_without_overlap_there_is_none() -> None:
    surfaces = scanned(blob, 0, 500, 0.002)
    away = TRUTH @ rigid.exp(np.array([0, 0, 0, 50.0, 0, 0]))
    np.testing.assert_array_equal(information(Pairs.of_points(surfaces, away)), np.zeros((6, 6)))


def test_information_turns_with_the_clouds_and_grows_with_the_points() -> None:
    few, many = (np.linalg.eigvalsh(information(aligned(scanned(blob, 0, n, 0.003), 0)[1])).min() for n in (1000, 8000))
    assert many > 3 * few
