"""What depends on one cloud alone: worked out once, the same whatever was asked before."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.prepared import ALL, BASE, FINE, LARGER, SMALL, Level, Prepared
from idam.clouds.voxels import downsample, ladder, rung
from idam.describe.invariant import Surroundings
from solids import noise, shell, spacing_by_definition

UTM = np.array([5e5, 5.6e6, 100.0])


class Counted:
    """A descriptor of two numbers a point that counts how often it is asked."""

    def __init__(self, key: str = "counted") -> None:
        self.key = key
        self.sizes: list[float] = []

    def describe(self, around: Surroundings) -> np.ndarray:
        self.sizes.append(float(np.ptp(around.points[:, 0])))
        return around.points[:, :2]


@pytest.fixture
def cloud() -> Prepared:
    return Prepared.of(shell(12_000, 1), "cloud")


def test_levels_hold_at_most_as_many_points_as_asked_for(cloud: Prepared) -> None:
    for count in (100, SMALL, LARGER, FINE):
        left = len(cloud.level(cloud.voxel_size(count)).points)
        assert 0.6 * count < left <= count


def test_voxel_sizes_are_rungs_of_the_ladder(cloud: Prepared) -> None:
    for count in (100, SMALL, FINE):
        size = cloud.voxel_size(count)
        assert size == ladder(rung(size))


def test_fewer_points_than_asked_for_stay_without_copies_and_strays() -> None:
    points = shell(300, 1)
    cloud = Prepared.of(np.vstack([points.repeat(2, 0), [[1e4, 0, 0]]]), "cloud")
    assert cloud.voxel_size(SMALL) == ALL
    np.testing.assert_allclose(cloud.level(ALL).points + cloud.centre, np.unique(points, axis=0), atol=1e-15)


def test_levels_are_made_once(cloud: Prepared) -> None:
    size = cloud.voxel_size(SMALL)
    level = cloud.level(size)
    assert cloud.level(size) is level
    assert level.surface(1.0) is level.surface(1.0)
    assert level.surface(2.0) is not level.surface(1.0)
    descriptor, other = Counted(), Counted("other")
    for _ in range(3):
        level.described(descriptor, level.spacing_rung)
    (size,) = descriptor.sizes  # in spacings
    assert size == pytest.approx(np.ptp(level.points[:, 0]) / ladder(level.spacing_rung), rel=1e-6)
    level.described(descriptor, level.spacing_rung + 1)
    assert len(descriptor.sizes) == 2
    level.described(other, level.spacing_rung)
    assert len(other.sizes) == 1


def test_same_bits_in_whatever_order_levels_are_asked_for() -> None:
    points = noise(2 * BASE // 3, 0) * [1.0, 0.6, 0.01]
    points = np.vstack([points, points + np.array([0.0, 0.0, 0.5])])  # more than the base holds
    one, other = Prepared.of(points, "one"), Prepared.of(points, "other")
    counts = (SMALL, LARGER, FINE, BASE)
    for count in counts:
        one.level(one.voxel_size(count))
    for count in reversed(counts):
        other.level(other.voxel_size(count))
    assert sorted(one.levels) == sorted(other.levels)
    for size, level in one.levels.items():
        np.testing.assert_array_equal(level.points, other.levels[size].points)
        assert level.spacing == other.levels[size].spacing
    assert len(one.base) <= BASE


def test_levels_are_those_of_the_centred_points(cloud: Prepared) -> None:
    size = cloud.voxel_size(SMALL)
    np.testing.assert_array_equal(cloud.level(size).points, downsample(cloud.points - cloud.centre, size))


def test_a_level_finer_than_the_base_is_thinned_from_all_points() -> None:
    points = noise(150_000, 0) * [1.0, 0.6, 0.01]
    cloud = Prepared.of(points, "cloud")
    size = cloud.voxel_size(BASE) / 8
    assert len(cloud.level(size).points) > len(cloud.base)


def test_surface_in_another_unit_has_the_same_points(cloud: Prepared) -> None:
    level = cloud.level(cloud.voxel_size(SMALL))
    np.testing.assert_array_equal(4 * level.surface(4.0).points, level.points)


def test_spacing_of_a_level() -> None:
    level = Level(shell(501, 3), ALL)
    assert level.spacing == pytest.approx(spacing_by_definition(level.points), rel=1e-9)
    assert level.spacing_rung == rung(level.spacing)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e9])
@pytest.mark.parametrize("place", [np.zeros(3), UTM], ids=["at the origin", "UTM"])
def test_unit_is_a_power_of_two_about_the_radius(unit: float, place: np.ndarray) -> None:
    cloud = Prepared.of(unit * (shell(500, 1) + place), "cloud")
    assert np.log2(cloud.unit) == round(np.log2(cloud.unit))
    assert 0.7 < cloud.radius / cloud.unit < 1.42
