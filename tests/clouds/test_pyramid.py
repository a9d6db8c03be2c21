"""Two clouds at several resolutions, and the way between the input's coordinates and working ones."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.clouds.frame import MIN_POINTS
from idam.clouds.prepared import FINE, LARGER, SMALL, Prepared
from idam.clouds.pyramid import FINEST, MOST_POINTS, PairLevel, Pyramid
from idam.describe.invariant import Surroundings
from idam.errors import InputError
from motions import any_rotation, move
from solids import noise, shell, spacing_by_definition

ORIGIN = np.zeros(3)
UTM = np.array([5e5, 5.6e6, 100.0])


def pyramid(source: np.ndarray, target: np.ndarray, voxel_size: float | None = None) -> Pyramid:
    return Pyramid(Prepared.of(source, "source"), Prepared.of(target, "target"), voxel_size)


@pytest.fixture(scope="module")
def large() -> Pyramid:
    return pyramid(shell(45_000, 1), 0.7 * shell(20_000, 2))


def levels(clouds: Pyramid) -> tuple[PairLevel, ...]:
    return clouds.small, clouds.larger, clouds.fine


# --- the levels ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "count"), [("small", SMALL), ("larger", LARGER), ("fine", FINE)])
def test_larger_cloud_has_about_so_many_points_and_no_more(large: Pyramid, name: str, count: int) -> None:
    level: PairLevel = getattr(large, name)
    assert level.size == len(level.source)
    assert 0.65 * count <= level.size <= count
    # on the same grid, half the surface
    assert level.source_level.voxel_size == level.target_level.voxel_size
    assert 0.3 * level.size < len(level.target) < 0.7 * level.size


def test_points_of_every_level_lie_on_the_surface(large: Pyramid) -> None:
    for level in levels(large):
        there = (level.source * level.unit + large.source.centre) / [0.9, 0.6, 0.5]
        # a mean of the points in a voxel lies a little inside
        assert np.abs(np.linalg.norm(there, axis=1) - 1).max() < 1.5 * level.spacing


def test_spacing_is_that_of_the_sparser_cloud(large: Pyramid) -> None:
    level = large.small
    assert level.spacing == pytest.approx(max(map(spacing_by_definition, (level.source, level.target))), rel=0.05)
    sparse = pyramid(shell(901, 1), shell(101, 2)).fine
    assert sparse.spacing * sparse.unit == pytest.approx(spacing_by_definition(shell(101, 2)), rel=1e-6)


def test_few_points_stay_as_they_are_on_every_level() -> None:
    source, target = shell(300, 1), shell(200, 2)
    clouds = pyramid(source, target)
    assert clouds.all_small
    assert clouds.larger is clouds.small
    for level in levels(clouds):
        np.testing.assert_allclose(
            level.source * level.unit + clouds.source.centre, np.unique(source, axis=0), atol=1e-15
        )
        assert len(level.target) == 200


def test_copies_of_points_change_nothing_but_rounding() -> None:
    source, target = shell(300, 1), shell(200, 2)
    for one, other in zip(levels(pyramid(source.repeat(3, 0), target)), levels(pyramid(source, target)), strict=True):
        assert len(one.source) == len(other.source)
        np.testing.assert_allclose(np.ptp(one.source, axis=0), np.ptp(other.source, axis=0), rtol=1e-12)


def test_clouds_exchanged_are_the_same_clouds() -> None:
    source, target = shell(6000, 1), 0.7 * shell(3000, 2)
    for voxel_size in (None, 0.2):
        forth, back = pyramid(source, target, voxel_size), pyramid(target, source, voxel_size)
        assert forth.unit == back.unit
        for one, other in zip(levels(forth), levels(back), strict=True):
            np.testing.assert_array_equal(one.source, other.target)
            np.testing.assert_array_equal(one.target, other.source)
            assert one.spacing == other.spacing


def test_levels_and_surfaces_are_made_once(large: Pyramid) -> None:
    assert large.larger is large.larger
    assert large.small.surfaces is large.small.surfaces
    np.testing.assert_array_equal(large.small.surfaces.source.points, large.small.source)
    again = Pyramid(large.source, large.target)
    assert again.small.source_level is large.small.source_level  # of the cloud, not of the pair


def test_both_clouds_are_described_at_one_spacing(large: Pyramid) -> None:
    asked = []

    class Noted:
        key = "noted"

        def describe(self, around: Surroundings) -> np.ndarray:
            asked.append(spacing_by_definition(around.points))
            return np.zeros((len(around.points), 2), np.float32)

    source, target = large.small.features(Noted())
    assert (len(source), len(target)) == (len(large.small.source), len(large.small.target))
    # the points are in spacings of the sparser cloud
    assert max(asked) == pytest.approx(1.0, rel=0.1)
    both = [spacing_by_definition(points) for points in (large.small.source, large.small.target)]
    assert asked[0] / asked[1] == pytest.approx(both[0] / both[1], rel=1e-5)


# --- voxel_size ----------------------------------------------------------------------------------------------------


def test_voxel_size_sets_the_clouds_to_match_and_no_other() -> None:
    source, target = shell(6000, 1), shell(3000, 2)
    given, chosen = pyramid(source, target, 0.2), pyramid(source, target)
    assert given.small is given.larger
    assert MIN_POINTS < len(given.small.source) < 500
    wider = pyramid(source, target, 0.3).small
    assert len(wider.source) < len(given.small.source)
    assert wider.spacing > given.small.spacing
    np.testing.assert_array_equal(given.fine.source, chosen.fine.source)
    np.testing.assert_array_equal(given.fine.target, chosen.fine.target)


def test_voxel_size_below_the_finest_counts_as_the_finest() -> None:
    source, target = shell(300, 1), shell(200, 2)
    tiny = pyramid(source, target, 1e-300)
    finest = pyramid(source, target, FINEST * tiny.unit)
    np.testing.assert_array_equal(tiny.small.source, finest.small.source)


@pytest.mark.parametrize("small_is", ["source", "target"])
def test_voxel_size_that_leaves_too_little_of_a_cloud_is_refused_by_its_name(small_is: str) -> None:
    clouds = shell(500, 1), shell(500, 2) / 10
    with pytest.raises(InputError, match=rf"^{small_is}: \d+ points are left .*at least {MIN_POINTS} .*smaller voxel"):
        _ = pyramid(*(clouds if small_is == "target" else clouds[::-1]), 0.2).small


@pytest.mark.parametrize("large_is", ["source", "target"])
def test_voxel_size_that_leaves_more_than_fits_is_refused_by_name(large_is: str) -> None:
    clouds = shell(MOST_POINTS + 500, 1), shell(500, 2)
    with pytest.raises(InputError, match=rf"^{large_is}: \d+ points .*at most {MOST_POINTS} .*larger voxel_size"):
        _ = pyramid(*(clouds if large_is == "source" else clouds[::-1]), 1e-3).small


@pytest.mark.parametrize("large_is", ["source", "target"])
def test_clouds_in_millimetres_and_in_metres_are_told_so(large_is: str) -> None:
    clouds = 1000 * shell(5000, 1), shell(5000, 2)
    other = "target" if large_is == "source" else "source"
    with pytest.raises(InputError, match=rf"^{large_is}: \d+ times the size of {other}; if their units differ, scale"):
        _ = pyramid(*(clouds if large_is == "source" else clouds[::-1])).small


# --- coordinates ---------------------------------------------------------------------------------------------------


@pytest.fixture(params=[(1.0, ORIGIN), (1e-9, ORIGIN), (1e9, ORIGIN), (1.0, UTM), (1000.0, UTM)], ids=str)
def somewhere(request: pytest.FixtureRequest) -> Pyramid:
    unit, place = request.param
    return pyramid(unit * shell(500, 1) + place, 0.7 * unit * shell(400, 2) - place[::-1])


def random_transforms(count: int) -> np.ndarray:
    random = np.random.default_rng(0)
    return rigid.transform([any_rotation(random) for _ in range(count)], random.normal(size=(count, 3)))


def test_enter_undoes_leave(somewhere: Pyramid) -> None:
    working = random_transforms(20)
    back = somewhere.enter(somewhere.leave(working))
    np.testing.assert_array_equal(back[:, :3, :3], working[:, :3, :3])
    np.testing.assert_allclose(back, working, rtol=0, atol=1e-8)  # float64 at 5.6e6 has steps of 1e-9


def test_leave_undoes_enter_where_the_points_are(somewhere: Pyramid) -> None:
    for full in somewhere.leave(random_transforms(5)):
        there_and_back = somewhere.leave(somewhere.enter(full))
        # transforms of far-off clouds have huge translations: what counts is where they move the points
        np.testing.assert_allclose(
            move(there_and_back, somewhere.source.points),
            move(full, somewhere.source.points),
            rtol=0,
            atol=1e-8 * somewhere.unit,
        )


def test_working_transform_moves_points_where_the_full_one_does(somewhere: Pyramid) -> None:
    for working in random_transforms(5):
        full = somewhere.leave(working)
        source, target = somewhere.source, somewhere.target
        there = (move(full, source.points) - target.centre) / somewhere.unit
        np.testing.assert_allclose(there, move(working, (source.points - source.centre) / somewhere.unit), atol=2e-8)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1000.0, 1e9])
def test_any_unit_gives_the_same_working_clouds_up_to_a_factor(unit: float) -> None:
    source, target = shell(700, 1), 0.7 * shell(400, 2)
    one, other = pyramid(source, target).fine, pyramid(unit * source, unit * target).fine
    factor = one.unit * unit / other.unit
    assert 0.49 < factor < 2.01
    np.testing.assert_allclose(other.source, factor * one.source, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(other.target, factor * one.target, rtol=1e-9, atol=1e-12)
    assert other.spacing == pytest.approx(factor * one.spacing, rel=1e-9)


def test_working_clouds_are_about_the_unit_sphere(somewhere: Pyramid) -> None:
    radii = np.linalg.norm(somewhere.fine.source, axis=1)
    assert 0.6 < np.quantile(radii, 0.98) < 1.5
    assert np.abs(somewhere.fine.source.mean(0)).max() < 0.1


# --- information ---------------------------------------------------------------------------------------------------


def cost(points: np.ndarray, normals: np.ndarray, moved: np.ndarray, change: np.ndarray) -> float:
    """Squared distances from planes through moved points, after T exp(x) instead of T."""
    miss = (rigid.apply(moved @ rigid.exp(change), points) - rigid.apply(moved, points)) * normals
    return float((miss.sum(1) ** 2).sum())


@pytest.mark.parametrize(("unit", "place"), [(1.0, ORIGIN), (1000.0, ORIGIN), (1.0, np.array([50.0, -20.0, 5.0]))])
def test_information_left_is_what_small_changes_of_the_full_transform_cost(unit: float, place: np.ndarray) -> None:
    clouds = pyramid(unit * shell(60, 1) + place, unit * shell(80, 2))
    full = clouds.leave(random_transforms(1)[0])
    working, points = clouds.enter(full), (clouds.source.points - clouds.source.centre) / clouds.unit
    normals = noise(60, 5)
    along = normals @ working[:3, :3]
    gradient = np.concatenate([np.cross(points, along), along], 1)
    information = clouds.information_left(gradient.T @ gradient)
    scale = np.array([1.0, 1.0, 1.0, *[unit] * 3]) / (1 + np.linalg.norm(place)) * 1e-5
    for x in np.random.default_rng(0).normal(size=(10, 6)) * scale:
        # in working units, as the residuals were
        expected = cost(clouds.source.points, normals, full, x) / clouds.unit**2
        assert x @ information @ x == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("count", [300, 5000])
def test_other_units_are_named(count: int) -> None:
    points = np.random.default_rng(0).normal(size=(count, 3))
    with pytest.raises(InputError, match=r"1000 times the size of .*; if their units differ"):
        _ = Pyramid(Prepared.of(points, "metres"), Prepared.of(1000 * points, "millimetres")).small
