"""Two clouds at several resolutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from idam.clouds import pyramid
from idam.clouds.frame import MIN_POINTS
from idam.clouds.pyramid import (
    FINE_POINTS,
    FINEST,
    MATCHING_POINTS,
    MOST_POINTS,
    NETWORK_POINTS,
    SAMPLE,
    Level,
    Pyramid,
    build_pyramid,
)
from idam.errors import InputError


def shell(count: int, seed: int) -> np.ndarray:
    """Points on an ellipsoid that fits the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [0.9, 0.6, 0.5]


@pytest.fixture(scope="module")
def large() -> Pyramid:
    return build_pyramid(shell(45_000, 1), 0.7 * shell(20_000, 2), None)


def levels(clouds: Pyramid) -> tuple[Level, ...]:
    return clouds.small, clouds.larger, clouds.fine


def same(a: Pyramid, b: Pyramid) -> None:
    for one, other in zip(levels(a), levels(b), strict=True):
        np.testing.assert_array_equal(one.source, other.source)
        np.testing.assert_array_equal(one.target, other.target)
        assert one.spacing == other.spacing


def spacing_by_definition(points: np.ndarray) -> float:
    distance = cdist(points, points)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(1)))


@pytest.mark.parametrize(
    ("name", "count"),
    [("small", NETWORK_POINTS), ("larger", MATCHING_POINTS), ("fine", FINE_POINTS)],
)
def test_larger_cloud_has_about_so_many_points_and_no_more(large: Pyramid, name: str, count: int) -> None:
    level: Level = getattr(large, name)
    assert 0.85 * count <= len(level.source) <= count
    # on the same grid, half the surface
    assert 0.3 * len(level.source) < len(level.target) < 0.7 * len(level.source)


def test_points_of_every_level_lie_on_the_surface(large: Pyramid) -> None:
    for level in (large.small, large.larger):
        # a mean of the points in a voxel lies a little inside
        assert np.abs(np.linalg.norm(level.source / [0.9, 0.6, 0.5], axis=1) - 1).max() < level.spacing


def test_spacing_is_that_of_the_cloud_with_the_wider(large: Pyramid) -> None:
    for level in (large.small, large.larger):
        expected = max(map(spacing_by_definition, (level.source, level.target)))
        assert level.spacing == pytest.approx(expected, rel=1e-6)
    sparse = build_pyramid(shell(900, 1), shell(100, 2), None)
    assert sparse.fine.spacing == pytest.approx(spacing_by_definition(shell(100, 2)))


def test_spacing_of_many_points_is_that_of_some_all_over_the_cloud() -> None:
    # a third of the points lie three times as far apart, and the voxel grid puts them first or last
    dense, sparse = shell(5000, 1), 3 * shell(2500, 2)
    for away in (-9.0, 9.0):
        cloud = np.vstack([dense, sparse + np.array([away, 0, 0])])
        many = pyramid.level(cloud, cloud, 10_000)
        assert len(many.source) > 3 * SAMPLE
        expected = np.median(cKDTree(cloud).query(cloud, k=2)[0][:, 1])
        assert many.spacing == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("count", [100, 700, 3000])
def test_a_level_has_about_as_many_points_as_asked_for(count: int) -> None:
    source, target = shell(9000, 1), 0.7 * shell(9000, 2)
    found = pyramid.level(source, target, count)
    assert 0.8 * count <= len(found.source) <= count
    assert 0.3 * len(found.source) < len(found.target) < 0.7 * len(found.source)
    other = pyramid.level(target, source, count)
    np.testing.assert_array_equal(other.target, found.source)
    assert other.spacing == found.spacing


def test_few_points_stay_as_they_are_on_every_level() -> None:
    source, target = shell(300, 1), shell(200, 2)
    clouds = build_pyramid(source, target, None)
    assert clouds.larger is clouds.small
    for level in levels(clouds):
        np.testing.assert_array_equal(level.source, np.unique(source, axis=0))
        np.testing.assert_array_equal(level.target, np.unique(target, axis=0))


def test_copies_of_points_change_nothing() -> None:
    source, target = shell(300, 1), shell(200, 2)
    same(build_pyramid(source.repeat(3, 0), target, None), build_pyramid(source, target, None))


def test_swapped_exchanges_source_and_target(large: Pyramid) -> None:
    for level, other in zip((large.small, large.fine), (large.swapped().small, large.swapped().fine), strict=True):
        assert other.source is level.target
        assert other.target is level.source
        assert other.spacing == level.spacing
    same(large.swapped().swapped(), large)


def test_swapped_is_the_pyramid_of_the_swapped_clouds() -> None:
    source, target = shell(6000, 1), 0.7 * shell(3000, 2)
    same(build_pyramid(source, target, None).swapped(), build_pyramid(target, source, None))
    same(build_pyramid(source, target, 0.2).swapped(), build_pyramid(target, source, 0.2))


def test_surfaces_are_those_of_the_level_and_made_once(large: Pyramid) -> None:
    level = large.small
    assert level.surfaces is level.surfaces
    np.testing.assert_array_equal(level.surfaces.source.points, level.source)
    np.testing.assert_array_equal(level.surfaces.target.points, level.target)


# --- voxel_size ----------------------------------------------------------------------------------------------------


def test_larger_clouds_are_made_once(large: Pyramid) -> None:
    assert large.larger is large.larger
    assert not large.all_small


def test_voxel_size_sets_the_clouds_to_match_and_no_other() -> None:
    source, target = shell(6000, 1), shell(3000, 2)
    given, chosen = build_pyramid(source, target, 0.2), build_pyramid(source, target, None)
    assert given.small is given.larger
    assert MIN_POINTS < len(given.small.source) < 500
    wider = build_pyramid(source, target, 0.3).small
    assert len(wider.source) < len(given.small.source)
    assert wider.spacing > given.small.spacing
    np.testing.assert_array_equal(given.fine.source, chosen.fine.source)
    np.testing.assert_array_equal(given.fine.target, chosen.fine.target)


def test_voxel_size_below_the_finest_counts_as_the_finest() -> None:
    source, target = shell(300, 1), shell(200, 2)
    same(build_pyramid(source, target, 1e-300), build_pyramid(source, target, FINEST))


@pytest.mark.parametrize("small_is", ["source", "target"])
def test_voxel_size_that_leaves_too_little_of_a_cloud_is_refused_by_its_name(small_is: str) -> None:
    clouds = shell(500, 1), shell(500, 2) / 100
    with pytest.raises(InputError, match=rf"^{small_is}: \d+ points are left .*at least {MIN_POINTS} .*smaller voxel"):
        build_pyramid(*(clouds if small_is == "target" else clouds[::-1]), 0.2)


@pytest.mark.parametrize("large_is", ["source", "target"])
def test_voxel_size_that_leaves_more_than_fits_is_refused_by_name(large_is: str) -> None:
    clouds = shell(MOST_POINTS + 500, 1), shell(500, 2)
    with pytest.raises(InputError, match=rf"^{large_is}: \d+ points .*at most {MOST_POINTS} .*larger voxel_size"):
        build_pyramid(*(clouds if large_is == "source" else clouds[::-1]), 1e-3)


def test_cloud_too_small_beside_the_other_is_refused() -> None:
    with pytest.raises(InputError, match=r"^target: \d+ points are left .*crop the other cloud"):
        build_pyramid(shell(5000, 1), shell(5000, 2) / 200, None)
