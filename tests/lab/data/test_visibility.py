"""What a viewpoint sees: the near half of a sphere, all of a sphere around it, and nothing behind a wall."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from idam.lab.data.visibility import seen_from_afar, seen_from_within

HERE = np.zeros(3)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def sphere(rng) -> np.ndarray:
    """60,000 points on the unit sphere."""
    points = rng.normal(size=(60_000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def sheet(rng: np.random.Generator, side: float, z: float, count: int = 40_000) -> np.ndarray:
    """A square across the z axis."""
    return np.c_[rng.uniform(-side / 2, side / 2, (count, 2)), np.full(count, z)]


@pytest.mark.parametrize("cells", [60, 110])
def test_from_afar_the_near_half_of_a_sphere_is_seen(cells, sphere):
    seen = seen_from_afar(sphere, np.eye(3), cells)
    assert 0.3 < seen.mean() < 0.5  # half of it without the rim, where it looks along the surface
    assert seen[sphere[:, 2] < -0.5].all()
    assert not seen[sphere[:, 2] > 0].any()


def test_from_the_centre_of_a_sphere_all_of_it_is_seen(sphere):
    assert seen_from_within(sphere, HERE).all()
    assert seen_from_within(3 * sphere + (5, 6, 7), np.array([5, 6, 7])).all()


def test_from_outside_a_sphere_its_far_side_is_hidden(sphere):
    seen = seen_from_within(sphere, np.array([-4.0, 0, 0]))  # from where the horizon lies at -0.25
    assert seen[sphere[:, 0] < -0.5].all()
    assert not seen[sphere[:, 0] > 0].any()


def along_z(points: np.ndarray) -> np.ndarray:
    return seen_from_afar(points, np.eye(3), 60)


def from_below(points: np.ndarray) -> np.ndarray:
    """From the origin, the z axis laid level: cells are slivers at the poles."""
    return seen_from_within(points[:, [2, 0, 1]], HERE)


@pytest.mark.parametrize("see", [along_z, from_below])
def test_a_wall_hides_what_is_behind_it_and_nothing_else(see, rng):
    wall, behind, beside = sheet(rng, 2.0, 1.0, 100_000), sheet(rng, 0.5, 2.0, 500), sheet(rng, 0.5, 2.0, 500)
    beside[:, 0] += 3
    kinds = np.repeat(["wall", "behind", "beside"], [100_000, 500, 500])
    seen = see(np.concatenate([wall, behind, beside]))
    assert (seen == (kinds != "behind")).all()
    has_window = np.abs(wall[:, :2]).max(1) > 0.4
    assert see(np.concatenate([wall[has_window], behind])).all()


def test_the_view_from_afar_is_along_the_z_axis_after_the_rotation(sphere):
    points = sphere[::10] * (1.0, 0.6, 0.3) + 5
    rotation = Rotation.from_euler("xyz", (0.4, -1.0, 2.0)).as_matrix()
    turned = seen_from_afar(points @ rotation.T, np.eye(3), 40)
    np.testing.assert_array_equal(seen_from_afar(points, rotation, 40), turned)
    assert (seen_from_afar(points, np.eye(3), 40) != turned).mean() > 0.2


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_scale_and_place_do_not_matter(scale, rng):
    points = rng.normal(size=(5000, 3))
    moved = scale * (points + np.array([8.0, -4.0, 2.0]))
    within = seen_from_within(points, points[0] + 0.1)
    assert 0.05 < within.mean() < 0.99
    assert (seen_from_within(moved, moved[0] + 0.1 * scale) == within).mean() > 0.999
    assert (seen_from_afar(moved, np.eye(3), 30) == seen_from_afar(points, np.eye(3), 30)).mean() > 0.999


def test_a_single_place_is_seen():
    points = np.ones((5, 3))
    assert seen_from_afar(points, np.eye(3), 60).all()
    assert seen_from_within(points, HERE).all()
    assert seen_from_within(points, points[0]).all()
