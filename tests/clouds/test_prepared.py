"""What depends on one cloud alone: worked out once, the same whatever was asked before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import idam
from idam.clouds.prepared import ALL, BASE, FINE, FORMAT, LARGER, SMALL, Level, Prepared
from idam.clouds.voxels import downsample, ladder, rung
from idam.describe.invariant import Surroundings
from idam.errors import InputError
from motions import move, rigid
from rooms import room
from solids import bracket, noise, shell, spacing_by_definition

UTM = np.array([5e5, 5.6e6, 100.0])
POSE = rigid([1.0, -1.5, 0.8], [1.0, 2.0, 3.0])


class Counted:
    """A descriptor of two numbers a point that counts how often it is asked, and at what spacing."""

    def __init__(self, key: str = "counted") -> None:
        self.key = key
        self.spacings: list[float] = []

    def describe(self, around: Surroundings) -> np.ndarray:
        self.spacings.append(spacing_by_definition(around.points))
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
    assert descriptor.spacings == [pytest.approx(level.spacing / ladder(level.spacing_rung), rel=1e-5)]
    level.described(descriptor, level.spacing_rung + 1)
    assert len(descriptor.spacings) == 2
    level.described(other, level.spacing_rung)
    assert len(other.spacings) == 1


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
    np.testing.assert_array_equal(one.base, other.base)
    assert len(one.base) <= BASE


def test_levels_are_those_of_the_centred_points(cloud: Prepared) -> None:
    fine, small = cloud.voxel_size(FINE), cloud.voxel_size(SMALL)
    np.testing.assert_array_equal(cloud.level(fine).points, downsample(cloud.points - cloud.centre, fine))
    np.testing.assert_array_equal(cloud.level(small).points, downsample(cloud.level(fine).points, small))


def test_what_is_kept_of_a_large_cloud_bounds_every_level() -> None:
    points = noise(150_000, 0) * [1.0, 0.6, 0.01]
    cloud = Prepared.of(points, "cloud")
    assert 0.6 * BASE < len(cloud.base) <= BASE
    for size in (ALL, cloud.radius / 1e4):
        assert len(cloud.level(size).points) == len(cloud.base)
    assert len(cloud.points) == 150_000  # and what was given stays


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


# --- the viewpoint -------------------------------------------------------------------------------------------------


def test_the_eye_of_a_scan_is_the_origin_of_its_frame() -> None:
    seen = room(20_000)
    cloud = Prepared.of(seen, "cloud")
    assert cloud.eye is not None
    # around the centre, as its levels are
    np.testing.assert_array_equal(cloud.eye, -cloud.centre)
    # of what was moved since, nobody knows from where
    assert Prepared.of(seen + np.array([30.0, 5.0, 0.0]), "moved").eye is None


# --- saved and loaded ----------------------------------------------------------------------------------------------


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    descriptor = Counted()
    cloud = Prepared.of(bracket(1300, seed=1) + UTM, "scans/a b.ply")
    for count in (200, SMALL):
        level = cloud.level(cloud.voxel_size(count))
        level.described(descriptor, level.spacing_rung)
        level.described(descriptor, level.spacing_rung + 1)
    cloud.save(tmp_path / "a.idam")
    assert [path.name for path in tmp_path.iterdir()] == ["a.idam"]
    loaded = Prepared.load(str(tmp_path / "a.idam"))
    assert (loaded.name, loaded.radius, loaded.unit) == (cloud.name, cloud.radius, cloud.unit)
    np.testing.assert_array_equal(loaded.points, cloud.points)
    np.testing.assert_array_equal(loaded.centre, cloud.centre)
    assert loaded.levels.keys() == cloud.levels.keys()
    asked = len(descriptor.spacings)
    for size, level in cloud.levels.items():
        other = loaded.level(size)
        np.testing.assert_array_equal(other.points, level.points)
        assert other.features.keys() == level.features.keys()
        for step in (level.spacing_rung, level.spacing_rung + 1):
            np.testing.assert_array_equal(other.described(descriptor, step), level.described(descriptor, step))
    assert len(descriptor.spacings) == asked  # nothing is described anew


def test_a_saved_cloud_registers_to_the_same_bits(tmp_path: Path) -> None:
    source, target = bracket(1500, seed=1), move(POSE, bracket(1200, seed=2))
    expected = idam.register(source, target)
    path = tmp_path / "source.idam"
    idam.prepare(source).save(path)
    for cloud in (str(path), Prepared.load(path)):
        result = idam.register(cloud, target)
        np.testing.assert_array_equal(result.transformation, expected.transformation)
        np.testing.assert_array_equal(result.information, expected.information)
        assert (result.confidence, result.fitness, result.evidence) == (
            expected.confidence,
            expected.fitness,
            expected.evidence,
        )


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as error:
        Prepared.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: not a prepared cloud (")
    assert message.endswith("; make it anew with idam.prepare")
    assert "\n" not in message
    return message


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    idam.prepare(bracket(1500, seed=1)).save(tmp_path / "a.idam")
    return tmp_path / "a.idam"


@pytest.mark.parametrize("length", [0, 7, 200, -1, -5000])
def test_a_file_cut_short_is_refused(saved: Path, length: int) -> None:
    saved.write_bytes(saved.read_bytes()[:length])
    refusal(saved)


@pytest.mark.parametrize("content", [b"x y z\n0 0 0\n", b"ply\nformat ascii 1.0\n", b"\0" * 5000])
def test_a_file_of_another_kind_is_refused(saved: Path, content: bytes) -> None:
    saved.write_bytes(content)
    refusal(saved)
    with pytest.raises(InputError, match="not a prepared cloud"):
        idam.register(saved, bracket(300, seed=1))


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refusal(tmp_path / "missing.idam")
    refusal(tmp_path)


def test_weights_and_other_arrays_are_no_clouds(tmp_path: Path) -> None:
    arrays = {"points": np.zeros((30, 3)), "centre": np.zeros(3)}
    for about in (None, {"idam": "nonsense"}, {"idam": "[]"}, {"idam": '{"format": 1}'}):
        save_file(arrays, tmp_path / "a.idam", about)
        refusal(tmp_path / "a.idam")


def test_another_format_is_refused_and_a_missing_array(saved: Path) -> None:
    arrays = load_file(saved)
    about = '{"format": %d, "name": "a", "radius": 1.0, "sizes": [0.5]}'
    save_file({"points": arrays["points"], "centre": arrays["centre"]}, saved, {"idam": about % FORMAT})
    refusal(saved)
    save_file(arrays, saved, {"idam": about % (FORMAT + 1)})
    assert "another version of idam" in refusal(saved)


def test_where_nothing_can_be_written_nothing_is(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        Prepared.of(bracket(300, seed=1), "cloud").save(tmp_path / "missing" / "a.idam")
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []
