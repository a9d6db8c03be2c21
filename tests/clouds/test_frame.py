"""From any two clouds to two small, centred, scaled ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from idam.clouds.frame import (
    MIN_POINTS,
    STRAY,
    Frame,
    check_points,
    choose_voxel_size,
    common_frame,
    downsample,
    voxels,
    without_strays,
)
from idam.errors import InputError
from motions import move, rigid

ORIGIN = np.zeros(3)
UTM = np.array([5e5, 5.6e6, 100.0])
PLACES = pytest.mark.parametrize("place", [ORIGIN, UTM], ids=["at the origin", "UTM"])


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def source(random: np.random.Generator) -> np.ndarray:
    """A bent sheet of 3 by 2 by 1 units, 600 points, about 0.1 apart."""
    x, y = random.uniform(-1, 1, (2, 600))
    return np.stack([1.5 * x, y, np.sin(2 * x) * np.cos(y) / 2], 1)


@pytest.fixture
def target(source: np.ndarray) -> np.ndarray:
    """A smaller part of the sheet, elsewhere."""
    return source[source[:, 0] > -0.5] @ Rotation.from_rotvec([0.2, -0.9, 0.4]).as_matrix().T + [4.0, -2.0, 7.0]


def refusal(points: np.ndarray, name: str = "a.ply") -> str:
    with pytest.raises(InputError) as error:
        check_points(points, name)
    message = str(error.value)
    assert message.startswith(f"{name}: ")
    assert "\n" not in message
    return message


# --- the frame -----------------------------------------------------------------------------------------------------


@PLACES
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1000.0])
def test_undo_and_enter_are_inverse(source: np.ndarray, target: np.ndarray, place: np.ndarray, unit: float) -> None:
    source, target = unit * source + place, unit * target - place
    frame = common_frame(source, target)
    working = rigid([0.3, 1.9, -0.8], np.array([0.1, -0.2, 0.3]))
    full = frame.undo(working)
    np.testing.assert_allclose(frame.enter(full), working, atol=1e-6)
    # transforms of far-off clouds have huge translations: what counts is where they lay the points
    spacing = 0.1 * unit
    there_and_back = frame.undo(frame.enter(full))
    np.testing.assert_allclose(move(there_and_back, source), move(full, source), rtol=0, atol=1e-6 * spacing + 2e-9)


@PLACES
def test_working_transform_lays_points_where_the_full_one_does(
    source: np.ndarray, target: np.ndarray, place: np.ndarray
) -> None:
    source, target = source + place, target - 2 * place
    frame = common_frame(source, target)
    full = frame.undo(rigid([2.0, 0.5, 1.0], np.array([-0.3, 0.2, 0.1])))
    there = frame.target(move(full, source))
    np.testing.assert_allclose(there, move(frame.enter(full), frame.source(source)), atol=1e-7)


def test_frame_of_its_own_centres_is_a_scaled_identity() -> None:
    frame = Frame(np.array([1.0, 2.0, 3.0]), np.array([-4.0, 5.0, 6.0]), 2.0)
    np.testing.assert_array_equal(frame.undo(np.eye(4))[:3, 3], [-5.0, 3.0, 3.0])
    np.testing.assert_array_equal(frame.undo(rigid([0, 0, 0], np.ones(3)))[:3, 3], [-3.0, 5.0, 5.0])


@PLACES
@pytest.mark.parametrize("unit", [1e-3, 0.3048, 1000.0])
def test_any_unit_and_place_gives_the_same_working_clouds(
    source: np.ndarray, target: np.ndarray, place: np.ndarray, unit: float
) -> None:
    frame, there = common_frame(source, target), common_frame(unit * source + place, unit * target - place)
    tolerance = 1e-8 / unit if place.any() else 1e-12  # float64 at 5.6e6 has steps of 1e-9
    np.testing.assert_allclose(there.source(unit * source + place), frame.source(source), atol=tolerance)
    np.testing.assert_allclose(there.target(unit * target - place), frame.target(target), atol=tolerance)
    assert there.scale == pytest.approx(unit * frame.scale)


def test_larger_cloud_just_fits_the_unit_sphere(source: np.ndarray, target: np.ndarray) -> None:
    frame = common_frame(source, target)
    radii = [np.linalg.norm(points, axis=1) for points in (frame.source(source), frame.target(target))]
    assert np.quantile(radii[0], 0.98) == pytest.approx(1.0, rel=0.02)
    assert np.quantile(radii[1], 0.98) < 0.9
    mirrored = common_frame(target, source)
    assert mirrored.scale == frame.scale
    np.testing.assert_array_equal(mirrored.target_centre, frame.source_centre)


@pytest.mark.parametrize("distance", [1e2, 1e6])
def test_a_stray_point_shrinks_nothing_else(source: np.ndarray, target: np.ndarray, distance: float) -> None:
    frame, strayed = common_frame(source, target), common_frame(np.vstack([source, [[distance, 0, 0]]]), target)
    assert strayed.scale == pytest.approx(frame.scale, rel=0.05)
    np.testing.assert_allclose(strayed.source(source), frame.source(source), atol=0.1)


def test_order_of_the_points_changes_no_more_than_rounding(
    random: np.random.Generator, source: np.ndarray, target: np.ndarray
) -> None:
    frame = common_frame(source, target)
    shuffled = common_frame(random.permutation(source), target[::-1])
    np.testing.assert_allclose(shuffled.source_centre, frame.source_centre, rtol=0, atol=1e-14)
    np.testing.assert_allclose(shuffled.target_centre, frame.target_centre, rtol=0, atol=1e-14)
    assert shuffled.scale == pytest.approx(frame.scale, rel=1e-14)


@pytest.mark.parametrize("layout", [np.asfortranarray, lambda points: np.repeat(points, 2, axis=0)[::2]])
def test_layout_in_memory_does_not_matter(source: np.ndarray, target: np.ndarray, layout) -> None:
    frame, other = common_frame(source, target), common_frame(layout(source), layout(target))
    np.testing.assert_array_equal(other.source_centre, frame.source_centre)
    assert other.scale == frame.scale


@PLACES
def test_both_clouds_are_treated_alike(source: np.ndarray, target: np.ndarray, place: np.ndarray) -> None:
    def prepare(one: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
        frame = common_frame(one, other)
        clouds = [without_strays(frame.source(one)), without_strays(frame.target(other))]
        size = choose_voxel_size(clouds, 200)
        return [downsample(cloud, size) for cloud in clouds]

    there, back = prepare(source + place, target), prepare(target, source + place)
    for one, other in zip(there, reversed(back), strict=True):
        np.testing.assert_array_equal(one, other)


def test_strays_are_what_the_voxel_grid_has_no_room_for(random: np.random.Generator) -> None:
    directions = random.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = np.concatenate([random.uniform(0, 0.99 * STRAY, 200), STRAY * 10 ** random.uniform(0.01, 90, 100)])
    points = directions * distance[:, None]
    np.testing.assert_array_equal(without_strays(points), points[:200])


# --- what cannot be registered --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, MIN_POINTS - 1])
def test_too_few_points(source: np.ndarray, count: int) -> None:
    assert f"has {count} points" in refusal(source[:count])


def test_just_enough_points(source: np.ndarray) -> None:
    check_points(source[:MIN_POINTS], "a.ply")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers(source: np.ndarray, value: float) -> None:
    source[7, 2] = source[9] = value
    assert "2 of 600 points are NaN or infinite" in refusal(source, "source")


@pytest.mark.parametrize("place", [ORIGIN, UTM, np.full(3, 1 / 3)], ids=["at the origin", "UTM", "not a binary number"])
def test_points_all_equal(place: np.ndarray) -> None:
    assert "equal" in refusal(np.tile(place, (50, 1)))


@pytest.mark.parametrize(("place", "extent"), [(ORIGIN, 1e-3), (ORIGIN, 1.0), (UTM, 1.0), (UTM, 1e4)])
def test_points_on_a_line(random: np.random.Generator, place: np.ndarray, extent: float) -> None:
    line = random.uniform(size=(100, 1)) * extent * np.array([0.3, -0.8, 0.5]) + place
    assert "line" in refusal(line)


def test_two_places_are_a_line() -> None:
    assert "line" in refusal(np.repeat([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], 20, axis=0))


@PLACES
@pytest.mark.parametrize("extent", [1e-3, 1.0, 1e4])
def test_a_plane_passes(random: np.random.Generator, place: np.ndarray, extent: float) -> None:
    plane = random.uniform(size=(100, 2)) @ np.array([[1.0, 0.2, 0.3], [0.1, 0.9, -0.4]])
    check_points(extent * plane + place, "a.ply")


def test_a_stray_point_makes_no_line_of_a_surface(source: np.ndarray) -> None:
    check_points(np.vstack([source + UTM, np.zeros((1, 3))]), "a.ply")  # a scanner's (0, 0, 0) for "no return"
    check_points(np.vstack([source, [[1e9, 0, 0]]]), "a.ply")


# --- voxel grids ---------------------------------------------------------------------------------------------------


@pytest.fixture
def dense(random: np.random.Generator) -> np.ndarray:
    """A unit sphere of 6000 points."""
    points = random.normal(size=(6000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [100, 500, 2000])
def test_chosen_voxel_size_leaves_about_the_count_of_the_larger(dense: np.ndarray, count: int) -> None:
    size = choose_voxel_size([dense[:3000] / 2, dense], count)
    assert 0.9 * count <= len(downsample(dense, size)) <= count
    assert len(downsample(dense[:3000] / 2, size)) <= count
    assert size == choose_voxel_size([dense, dense[:3000] / 2], count)


@pytest.fixture(params=["surface", "curve", "volume", "hardly more than asked for"])
def crowd(request: pytest.FixtureRequest, random: np.random.Generator, dense: np.ndarray) -> np.ndarray:
    """Clouds whose voxels grow in number with different powers of their size."""
    return {
        "surface": dense,
        "curve": random.uniform(-1, 1, (6000, 1)) * [1.0, 0.01, 0.01],
        "volume": random.uniform(-1, 1, (6000, 3)),
        "hardly more than asked for": dense[:510],
    }[request.param]


def test_any_shape_of_cloud_leaves_nearly_the_count(crowd: np.ndarray) -> None:
    left = len(downsample(crowd, choose_voxel_size([crowd], 500)))
    assert 480 <= left <= 500


@pytest.mark.parametrize("count", [100, 1000])
def test_voxel_size_follows_from_neither_order(random: np.random.Generator, dense: np.ndarray, count: int) -> None:
    other = dense[::2] * [1.0, 0.5, 0.5]
    size = choose_voxel_size([dense, other], count)
    assert size == choose_voxel_size([other, dense], count)
    assert size == choose_voxel_size([random.permutation(dense), other[::-1]], count)


@pytest.mark.parametrize("copies", [2, 20])
def test_copies_are_no_further_points(dense: np.ndarray, copies: int) -> None:
    few = dense[:400]
    size = choose_voxel_size([np.repeat(few, copies, axis=0)], 500)
    assert len(downsample(few, size)) > 390


def test_points_on_a_lattice_leave_no_more_than_the_count() -> None:
    steps = np.linspace(-1, 1, 12)
    lattice = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    # whole layers of voxels fill at once, and around the centre two at a time: the next number is 8 ** 3
    assert len(downsample(lattice, choose_voxel_size([lattice], 500))) == 6**3


@pytest.mark.parametrize("size", [0.01, 0.13, 3.0])
def test_voxels_are_those_of_downsample(dense: np.ndarray, size: float) -> None:
    numbers = voxels(dense, size)
    assert numbers.shape == (len(dense),)
    assert len(np.unique(numbers)) == len(downsample(dense, size))
    _, index = np.unique(np.floor(dense / size), axis=0, return_inverse=True)
    same = index == index[0]
    np.testing.assert_array_equal(numbers == numbers[0], same)


def test_voxels_have_numbers_however_far_the_points() -> None:
    ends = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    far = voxels(np.vstack([ends, 1e9 * ends, 1e100 * ends]), 0.1)
    assert len(set(far)) == 4  # the far ones share the corners of the grid


def test_small_clouds_stay_whole(dense: np.ndarray) -> None:
    assert choose_voxel_size([dense[:500], dense[:300]], 500) == 0.0
    assert choose_voxel_size([dense[:501], dense[:300]], 500) > 0.0


def test_downsample_is_the_mean_of_each_voxel(dense: np.ndarray) -> None:
    voxels, index = np.unique(np.floor(dense / 0.25), axis=0, return_inverse=True)
    sums = np.zeros((len(voxels), 3))
    np.add.at(sums, index, dense)
    means = sums / np.bincount(index)[:, None]
    found = downsample(dense, 0.25)
    np.testing.assert_allclose(found[np.lexsort(found.T)], means[np.lexsort(means.T)], atol=1e-12)
    np.testing.assert_array_equal(found, downsample(dense, 0.25))


def test_order_of_the_points_changes_last_bits_of_the_means_alone(
    random: np.random.Generator, dense: np.ndarray
) -> None:
    found, shuffled = downsample(dense, 0.25), downsample(random.permutation(dense), 0.25)
    np.testing.assert_allclose(shuffled, found, rtol=0, atol=1e-14)
