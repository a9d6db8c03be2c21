"""Surfaces of our own making: their shapes and sizes, and that nothing else decides than the generator."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from idam.lab.data import surfaces
from idam.lab.data.surfaces import (
    box,
    cylinder,
    random_blob,
    random_object,
    random_room,
    random_street,
    stand,
    unit,
    warp,
)

SURFACES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "thing": lambda rng: random_object(500, rng),
    "blob": lambda rng: random_blob(500, rng),
    "room": lambda rng: random_room(500, rng)[0],
    "street": lambda rng: random_street(500, rng)[0],
}
WITH_PLACES = pytest.mark.parametrize("draw", [random_room, random_street])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def meshes() -> list[Any]:
    """A cube of edge 7 far from the origin."""
    return [trimesh.creation.box((7, 7, 7)).apply_translation((50, 0, 0))]


@pytest.mark.parametrize("name", SURFACES)
def test_a_surface_depends_on_the_generator_alone(name):
    np.random.seed(1)  # noqa: NPY002 - the one that must have no say
    one = SURFACES[name](np.random.default_rng(3))
    np.random.seed(2)  # noqa: NPY002
    same, other = (SURFACES[name](np.random.default_rng(seed)) for seed in (3, 4))
    np.testing.assert_array_equal(one, same)
    assert len(one) != len(other) or not np.isclose(one, other).all(1).any()


@pytest.mark.parametrize(("of_meshes", "of_parts"), [(1, 0), (0, 1), (0, 0)], ids=["mesh", "part", "blob"])
def test_a_thing_of_any_kind_is_centred_and_as_large_as_the_unit_sphere(of_meshes, of_parts, meshes, rng, monkeypatch):
    monkeypatch.setattr(surfaces, "MESHES", of_meshes)
    monkeypatch.setattr(surfaces, "PARTS", of_parts)
    things = [random_object(2000, rng, meshes) for _ in range(5)]
    for points in things:
        assert points.shape == (2000, 3)
        np.testing.assert_allclose(points.mean(0), 0, atol=1e-12)
        assert (np.linalg.norm(points, axis=1) <= 1).mean() == pytest.approx(0.98, abs=1e-3)
    # no two are alike: many of one's points are far from the other's surface
    distance = cKDTree(things[0]).query(things[1])[0]
    assert np.quantile(distance, 0.9) > 0.08


def test_meshes_are_taken_for_about_half_of_the_things(meshes, rng, monkeypatch):
    sampled = []
    monkeypatch.setattr(
        surfaces, "sample_surface", lambda mesh, count, rng: (sampled.append(mesh), rng.normal(size=(count, 3)))[1]
    )
    for _ in range(60):
        random_object(10, rng, meshes)
    assert 18 <= sum(mesh is meshes[0] for mesh in sampled) <= 42


def test_a_warp_bends_a_thing_without_tearing_it(rng):
    points = unit(rng.normal(size=(500, 3)))
    near = points + 1e-4 * rng.normal(size=points.shape)
    for seed in range(10):
        bent, bent_near = (warp(x, np.random.default_rng(seed)) for x in (points, near))
        stretch = np.linalg.norm(bent - bent_near, axis=1) / np.linalg.norm(points - near, axis=1)
        assert 0.1 < stretch.min() < stretch.max() < 5
        assert stretch.max() / stretch.min() > 1.05


def test_a_blob_is_one_continuous_surface_around_the_origin(rng):
    for _ in range(10):
        points = random_blob(4000, rng)
        radius = np.linalg.norm(points, axis=1)
        assert radius.min() > 0.25 - 1e-9
        assert 0.5 < np.median(radius) < 2
        distance, row = cKDTree(points / radius[:, None]).query(points / radius[:, None], k=2)
        slope = np.abs(radius - radius[row[:, 1]]) / distance[:, 1]
        assert slope.max() < 25  # a few dozen bumps at most around it
        assert radius.std() > 0.01


def test_a_box_has_its_points_on_its_sides_by_their_area(rng):
    size = np.array([1.0, 2.0, 4.0])
    across = np.abs(box(20_000, size, rng)) / (size / 2)
    assert across.max() <= 1 + 1e-12
    on = np.isclose(across, 1)
    assert on.any(1).all()
    area = np.array([8, 4, 2])
    np.testing.assert_allclose(on.mean(0), area / area.sum(), atol=0.02)


def test_a_cylinder_is_upright_about_the_origin(rng):
    points = cylinder(2000, 0.3, 4.0, rng)
    np.testing.assert_allclose(np.linalg.norm(points[:, :2], axis=1), 0.3)
    assert np.abs(points[:, 2]).max() == pytest.approx(2, abs=0.02)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.1)


def test_what_stands_is_turned_about_the_vertical_and_has_its_lowest_at_the_height(rng):
    points = rng.normal(size=(50, 3))
    stood = stand(points, 0.7, 2.0, 3.0, 0.4)
    assert stood[:, 2].min() == pytest.approx(0.4)
    np.testing.assert_allclose(np.ptp(stood[:, 2]), np.ptp(points[:, 2]))
    np.testing.assert_allclose(np.linalg.norm(stood[:, :2] - (2, 3), axis=1), np.linalg.norm(points[:, :2], axis=1))
    cosine = (points[:, :2] * (stood[:, :2] - (2, 3))).sum(1) / (points[:, :2] ** 2).sum(1)
    np.testing.assert_allclose(cosine, np.cos(0.7))


@WITH_PLACES
def test_a_scene_has_about_as_many_points_as_asked_for(draw, rng):
    for _ in range(5):
        points, places = draw(6000, rng)
        assert 3000 < len(points) <= 6000
        assert np.isfinite(points).all()
        assert places.shape == (8, 3)


def test_a_room_has_a_floor_and_walls_but_no_ceiling_and_is_looked_at_from_within(rng, monkeypatch):
    monkeypatch.setattr(surfaces, "_furniture", lambda *_: np.zeros((1, 3)))
    for _ in range(10):
        points, places = random_room(6000, rng)
        walls = points[:-11]  # there are at most 11 pieces of furniture
        half, height = np.abs(walls[:, :2]).max(0), walls[:, 2].max()
        on_floor, on_wall = np.isclose(walls[:, 2], 0), np.isclose(np.abs(walls[:, :2]), half)
        assert (on_wall.any(1) | on_floor).all()
        assert on_floor.any()
        assert on_wall.any(0).all()
        assert (np.abs(places[:, :2]) < half).all()
        assert ((places[:, 2] > 0) & (places[:, 2] < height)).all()


def test_meshes_furnish_rooms(meshes, monkeypatch):
    asked = []
    monkeypatch.setattr(surfaces, "random_object", lambda count, rng, meshes: (asked.append(meshes), np.eye(3))[1])
    for seed in range(5):
        random_room(2000, np.random.default_rng(seed), meshes)
    assert asked
    assert all(given is meshes for given in asked)


def test_a_street_has_even_ground_things_on_it_and_places_above_it(rng):
    for _ in range(10):
        points, places = random_street(6000, rng)
        ground = points[:2000]
        assert np.abs(ground[:, 2]).max() <= 0.06
        np.testing.assert_allclose(np.ptp(ground[:, :2], axis=0), 6, atol=0.1)
        assert points[2000:, 2].max() > 0.2
        distance, row = cKDTree(ground[:, :2]).query(places[:, :2])
        assert (places[:, 2] > ground[row, 2] - 0.03 * distance).all()
