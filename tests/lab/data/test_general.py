"""General pairs: the truth holds, the overlap is what it says, and nothing else decides than the generator."""

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from idam.errors import InputError
from idam.lab.data import general
from idam.lab.data.general import (
    COUNTS,
    FEWEST,
    LEAST_OVERLAP,
    Material,
    draw_scans,
    load_meshes,
)
from idam.lab.data.own_pairs import OwnPair
from idam.lab.data.surfaces import random_blob
from idam.lab.data.working import TOUCHING, ScanPair

KINDS = ["_halves", "_views_of_an_object", "_views_of_a_room", "_views_of_a_street"]
kinds = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def material() -> Material:
    """Eight blobs in place of ModelNet40's shapes, and a torus as a mesh."""
    rng = np.random.default_rng(0)
    shapes = np.stack([random_blob(1024, rng) for _ in range(8)]).astype(np.float32)
    return Material(shapes, [trimesh.creation.torus(1.0, 0.4)])


@pytest.fixture(scope="module")
def pairs(material) -> list[ScanPair]:
    return [draw_scans(material, np.random.default_rng(seed)) for seed in range(20)]


@pytest.fixture
def scans(material) -> Callable[..., list[tuple[np.ndarray, np.ndarray]]]:
    """Draws pairs of one kind, in one frame and without noise."""

    def draw(kind: str, count: int = 3, material: Material = material) -> list[tuple[np.ndarray, np.ndarray]]:
        rng, found = np.random.default_rng(0), []
        while len(found) < count:
            drawn = getattr(general, kind)(material, rng)
            found += [] if drawn is None else [drawn]
        return found

    return draw


@pytest.fixture
def spotless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither noise nor strays."""
    for name in ("NOISE", "MUCH_NOISE", "STRAYS"):
        monkeypatch.setattr(general, name, 0.0)


def aligned(pair: ScanPair) -> np.ndarray:
    """The source under the truth."""
    return pair.source @ pair.transformation[:3, :3].T + pair.transformation[:3, 3]


def spacing(cloud: np.ndarray) -> float:
    """The median distance to the nearest other."""
    distance = cdist(cloud, cloud)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(1)))


def differ(one: ScanPair, other: ScanPair) -> bool:
    return not all(np.array_equal(a, b) for a, b in zip(*map(dataclasses.astuple, (one, other)), strict=True))


# draw_scans


def test_a_pair_depends_on_the_generator_alone(material, pairs):
    np.random.seed(1)  # noqa: NPY002 - the one that must have no say
    assert not any(differ(pair, draw_scans(material, np.random.default_rng(n))) for n, pair in enumerate(pairs[:5]))
    assert all(differ(*both) for both in pairwise(pairs))


def test_the_overlap_is_the_share_of_the_scan_that_overlaps_less(pairs):
    for pair in pairs:
        near = cdist(aligned(pair), pair.target) < TOUCHING * pair.spacing
        assert pair.overlap == pytest.approx(min(near.any(1).mean(), near.any(0).mean()))
        assert pair.overlap >= LEAST_OVERLAP
    assert min(pair.overlap for pair in pairs) < 0.5
    assert max(pair.overlap for pair in pairs) > 0.8


def test_scans_have_enough_points_and_their_spacing_is_the_wider_one_s(pairs):
    for pair in pairs:
        counts = len(pair.source), len(pair.target)
        assert FEWEST <= min(counts) <= max(counts) <= max(COUNTS)
        assert pair.spacing == pytest.approx(max(spacing(pair.source), spacing(pair.target)), rel=1e-4)
    assert max(len(pair.target) for pair in pairs) > 1.5 * min(len(pair.target) for pair in pairs)


def test_too_few_points_are_drawn_again(material, monkeypatch):
    rng = np.random.default_rng(0)
    blob = random_blob(2000, rng)
    assert general._as_scanned(blob, blob[: FEWEST - 1], rng) is None
    monkeypatch.setattr(general, "FEWEST", 900)
    pairs = [draw_scans(material, np.random.default_rng(seed)) for seed in range(3)]
    assert all(min(len(pair.source), len(pair.target)) >= 900 for pair in pairs)


def test_what_overlaps_too_little_is_drawn_again(material, monkeypatch):
    monkeypatch.setattr(general, "LEAST_OVERLAP", 0.6)
    monkeypatch.setattr(general, "MORE_OVERLAP", 0.6)
    assert all(draw_scans(material, np.random.default_rng(seed)).overlap >= 0.6 for seed in range(5))


def test_scans_are_in_working_coordinates(pairs):
    for pair in pairs:
        core = [np.quantile(np.linalg.norm(cloud, axis=1), 0.9) for cloud in (pair.source, pair.target)]
        # the unit is the power of two nearest to the radius of most returns, and a LiDAR's farthest lie beyond
        assert 0.4 < max(core) < 4
        assert max(np.linalg.norm(np.median(cloud, 0)) for cloud in (pair.source, pair.target)) < 1


def test_one_s_own_scans_are_half_of_the_pairs_and_keep_their_truth(material, monkeypatch):
    monkeypatch.setattr(general, "COUNTS", (600,) * 4)
    rng = np.random.default_rng(0)
    cloud, far, truth = random_blob(3000, rng), np.array([4e5, 5e6, 100.0]), np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.random(random_state=rng).as_matrix(), [1, 2, 3]
    target = (cloud[1000:] + far) @ truth[:3, :3].T + truth[:3, 3]
    own = dataclasses.replace(material, pairs=[OwnPair(cloud[:2000] + far, target, truth)])
    drawn = [general._own_scans(own, np.random.default_rng(n)) for n in range(4)]
    for pair in drawn:
        near = cdist(aligned(pair), pair.target).min(1)
        assert np.median(near) < pair.spacing
    assert all(differ(*both) for both in pairwise(drawn))
    monkeypatch.setattr(general, "_own_scans", lambda *_: "mine")
    draws = [draw_scans(own, np.random.default_rng(seed)) for seed in range(12)]
    assert 2 <= sum(isinstance(draw, str) for draw in draws) <= 10


def test_rotations_are_any(pairs):
    angles = [Rotation.from_matrix(pair.transformation[:3, :3]).magnitude() for pair in pairs]
    assert max(angles) > 2.6
    assert np.mean(np.degrees(angles)) == pytest.approx(126, abs=25)  # 90 + 360 / pi^2 of SO(3)


# what is scanned


@kinds
def test_scans_share_no_points(kind, scans):
    for source, target in scans(kind):
        rows = {tuple(point) for point in source}
        assert len(rows) == len(source)
        assert not any(tuple(point) in rows for point in target)


def test_a_half_and_its_crop_are_of_one_shape(material, scans):
    for source, target in scans("_halves"):
        whole = np.concatenate([source, target])
        owners = [shape for shape in material.shapes if (cdist(whole, shape).min(1) < 1e-6).all()]
        assert len(owners) == 1
        assert all(0.55 * 512 - 1 <= len(scan) <= 512 for scan in (source, target))


def test_a_street_is_denser_near_its_scanner_and_ends_with_its_range(scans):
    for scan, _ in scans("_views_of_a_street"):
        distance = np.linalg.norm(scan - (np.median(scan[:, 0]), 0, 0.1), axis=1)
        assert np.median(distance) < 1.2
        assert distance.max() < general.RANGE + 1


# as scanned


def test_under_the_truth_two_scans_of_one_cloud_are_one(spotless):
    rng = np.random.default_rng(0)
    for _ in range(5):
        cloud = random_blob(4000, rng) * (1.0, 0.8, 0.6) + 5
        pair = general._as_scanned(cloud, cloud, rng)
        assert pair.overlap > 0.99
        # a voxel grid at another angle has other means, all on the surface
        assert np.median(cdist(aligned(pair), pair.target).min(1)) < 0.6 * pair.spacing
        rotation = pair.transformation[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0


def test_a_part_keeps_its_place_and_size_in_the_whole(spotless):
    rng = np.random.default_rng(0)
    blob = random_blob(6000, rng)
    pair = general._as_scanned(70 * blob, 70 * blob[blob[:, 0] > 0], rng)
    distance = cdist(pair.target, aligned(pair)).min(1)
    assert (distance < TOUCHING * pair.spacing).mean() > 0.98


@pytest.mark.parametrize(("name", "value"), [("NOISE", 0.0), ("STRAYS", 0.0), ("COUNTS", (300, 400, 500, 600))])
def test_every_part_of_a_scan_s_fate_plays_its_part(name, value, material, pairs, monkeypatch):
    monkeypatch.setattr(general, name, value)
    assert any(differ(pair, draw_scans(material, np.random.default_rng(n))) for n, pair in enumerate(pairs))


@pytest.fixture
def off_the_plane(monkeypatch) -> Callable[[float, float], list[np.ndarray]]:
    """Scans a plane 30 times with noise and strays: how far its points are from it then."""
    plane = np.random.default_rng(0).uniform(-1, 1, (900, 3)) * (1, 1, 0)

    def scan(sigma: float, strays: float) -> list[np.ndarray]:
        for name, value in (("NOISE", sigma), ("MUCH_NOISE", sigma), ("STRAYS", strays), ("COUNTS", (1000,) * 4)):
            monkeypatch.setattr(general, name, value)
        clouds = [general._as_scanned(plane, plane, np.random.default_rng(seed)).source for seed in range(30)]
        return [np.abs(cloud - np.median(cloud, 0))[:, 2] for cloud in clouds]

    return scan


def test_noise_and_strays_leave_the_surface(off_the_plane):
    assert np.max(off_the_plane(0.0, 0.0)) < 1e-9
    medians = np.median(off_the_plane(0.02, 0.0), 1)
    assert medians.min() < 0.002
    assert 0.005 < medians.max() < 0.02
    strayed = np.array([(distance > 1e-9).mean() for distance in off_the_plane(0.0, 0.2)])
    assert 0.1 < (strayed > 0).mean() < 0.6  # every third scan has some
    assert 0.1 < strayed.max() < 0.25


# meshes


def test_the_meshes_of_a_folder_are_loaded_by_name(tmp_path):
    for name, extent in (("b", 2), ("a", 1), ("c", 3)):
        trimesh.creation.box((extent, 1, 1)).export(tmp_path / f"{name}.ply")
    (tmp_path / "readme.txt").write_text("not a mesh")
    assert [mesh.extents[0] for mesh in load_meshes(tmp_path)] == [1, 2, 3]


def test_where_there_is_no_folder_there_are_no_meshes(tmp_path):
    assert load_meshes(tmp_path / "meshes") == []


def triangle(corner: str, row: int) -> Callable[[Path], Any]:
    """Writes a mesh of one triangle."""
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    return lambda path: path.write_text(f"{header}0 0 0\n1 0 0\n{corner}\n3 0 1 {row}\n")


SPOILT: dict[str, Callable[[Path], Any]] = {
    "nonsense": lambda path: path.write_bytes(b"nonsense"),
    "empty": lambda path: path.write_bytes(b""),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "points alone": lambda path: trimesh.PointCloud(np.eye(3)).export(path),
    "an absent vertex": triangle("0 1 0", 9),
    "a vertex that is no number": triangle("0 nan 0", 2),
    "no area": triangle("2 0 0", 2),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_mesh_that_cannot_be_used_is_refused_in_one_line(spoil, tmp_path):
    trimesh.creation.icosphere().export(tmp_path / "a.ply")
    trimesh.creation.icosphere().export(tmp_path / "b.ply")
    spoil(tmp_path / "b.ply")
    with pytest.raises(InputError, match=r"b\.ply: .*remove it") as caught:
        load_meshes(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_mesh_is_sampled(scans, material):
    # with meshes, some of the things are others than without
    without = Material(material.shapes)
    pairs = zip(scans("_views_of_an_object", 3), scans("_views_of_an_object", 3, without), strict=True)
    assert any(not np.array_equal(one[0], other[0]) for one, other in pairs)
