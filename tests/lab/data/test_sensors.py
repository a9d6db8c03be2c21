"""Ray-cast pairs: rays meet what slow geometry says, scenery has the symmetries it claims, the truth holds."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from idam.lab.data import sensor_pairs
from idam.lab.data.drilled import random_drilled, random_flange
from idam.lab.data.raycast import Ground, Solid, cast, cast_drilled, depth_image
from idam.lab.data.scenes import SCENES, Scene, draw_scene
from idam.lab.data.sensor_pairs import (
    FAMILIES,
    FEWEST,
    LEAST_OVERLAP,
    SEEN,
    SensorPair,
    draw_part_in_whole,
    draw_sensor_pair,
    overlap_of,
)
from idam.lab.data.sensors import SENSORS, Sensor, draw_sensor
from idam.rigid import apply, exp

families = pytest.mark.parametrize("family", FAMILIES)
scenes = pytest.mark.parametrize("family", SCENES)


def rays(count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors all around."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def solid(kind: str, rng: np.random.Generator, label: int = 0) -> Solid:
    axes = Rotation.random(random_state=rng).as_matrix()
    return Solid(kind, rng.uniform(-2, 2, 3), rng.uniform(0.3, 1.5, 3), axes, label)


def gauge(solid: Solid, points: np.ndarray) -> np.ndarray:
    """1 on the surface, less inside."""
    unit = np.abs(solid.local(points))
    if solid.kind == "box":
        return unit.max(1)
    if solid.kind == "cylinder":
        return np.maximum(np.hypot(unit[:, 0], unit[:, 1]), unit[:, 2])
    return np.linalg.norm(unit, axis=1)


def off_the_surface(scene: Scene, points: np.ndarray) -> np.ndarray:
    """About how far points (N, 3) are from the nearest surface of the scene, (N,)."""
    off = [np.abs(gauge(solid, points) - 1) * solid.half.min() for solid in scene.solids]
    if scene.ground is not None:
        off.append(np.abs(points[:, 2] - scene.ground.height(points[:, 0], points[:, 1])))
    return np.min(off, 0)


def triangles_met(triangles: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How far rays go to the nearest of some triangles, by trying them all (Moeller and Trumbore)."""
    a, b, c = triangles.transpose(1, 0, 2)
    nearest = np.full(len(directions), np.inf)
    for n, ray in enumerate(directions):
        p = np.cross(ray, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("fi,fi->f", origin - a, p) / np.einsum("fi,fi->f", b - a, p)
            q = np.cross(origin - a, b - a)
            v = q @ ray / np.einsum("fi,fi->f", b - a, p)
            t = np.einsum("fi,fi->f", c - a, q) / np.einsum("fi,fi->f", b - a, p)
            met = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
        nearest[n] = met.min(initial=np.inf)
    return nearest


def residual(pair: SensorPair, transformation: np.ndarray) -> float:
    """Median distance of the source from the planes of the target, where it is among the target's points."""
    moved, tree = apply(transformation, pair.source[:: len(pair.source) // 3000 + 1]), cKDTree(pair.target)
    away, nearest = tree.query(moved)
    around = pair.target[tree.query(pair.target[nearest], k=12)[1]]
    reach = np.linalg.norm(around[:, 6] - around[:, 0], axis=1)
    flat = around - around.mean(1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", flat, flat))[1][:, :, 0]
    among = away < 2 * reach
    assert among.sum() > 20
    return float(np.median(np.abs(np.einsum("ni,ni->n", moved - pair.target[nearest], normal))[among]))


# rays


@pytest.mark.parametrize("inside", [False, True])
def test_rays_meet_boxes_where_they_meet_their_triangles(inside):
    rng = np.random.default_rng(0)
    for _ in range(5):
        box = solid("box", rng)
        mesh = trimesh.creation.box(2 * box.half)
        triangles = mesh.triangles @ box.axes.T + box.centre
        origin = box.centre + (0.3 * box.half if inside else np.array([2.5, -3, 2]))
        directions = rays(300, rng)
        hits = cast([box], None, origin, directions, 50.0)
        np.testing.assert_allclose(hits.distance, triangles_met(triangles, origin, directions), rtol=1e-9)
        assert (hits.label == np.where(np.isfinite(hits.distance), 0, -1)).all()
        assert np.isfinite(hits.distance).any()


@pytest.mark.parametrize("kind", ["box", "cylinder", "ellipsoid"])
@pytest.mark.parametrize("inside", [False, True])
def test_rays_end_on_the_surface_and_nowhere_before(kind, inside):
    rng = np.random.default_rng(1)
    for _ in range(5):
        met = solid(kind, rng)
        offset = 0.2 * met.half if inside else np.array([3.0, 2, -2])
        origin, directions = met.centre + offset, rays(4000, rng)
        if not inside:
            directions = 2 * directions - offset
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = cast([met], None, origin, directions, 50.0).distance
        hit = np.isfinite(distance)
        assert hit.all() if inside else 50 < hit.sum() <= 4000
        np.testing.assert_allclose(gauge(met, origin + distance[hit, None] * directions[hit]), 1, atol=1e-7)
        way = np.linspace(0.01, 0.99, 40)[:, None]
        for ray, end in zip(directions[::40], np.where(hit, distance, 10)[::40], strict=True):
            assert (met.holds(origin + way * end * ray) == inside).all()


def test_the_nearest_of_many_is_met_and_named():
    rng = np.random.default_rng(2)
    many = [solid(kind, rng, n) for n, kind in enumerate(["box", "cylinder", "ellipsoid"] * 4)]
    origin, directions = np.array([6.0, 0, 1]), rays(3000, rng)
    hits = cast(many, Ground.flat(), origin, directions, 50.0)
    alone = np.stack([cast([s], None, origin, directions, 50.0).distance for s in many])
    down = np.where(directions[:, 2] < 0, -1 / directions[:, 2], np.inf)
    down[down > 50] = np.inf
    np.testing.assert_allclose(hits.distance, np.minimum(alone.min(0), down))
    np.testing.assert_array_equal(hits.label, np.where(alone.min(0) < down, alone.argmin(0), -1))
    assert len(set(hits.label.tolist())) > 4


def test_rays_end_on_relief_and_pass_over_none():
    rng = np.random.default_rng(3)
    ground = Ground(np.array([0.4, 0.3]), np.array([[0.3, 0.1], [-0.1, 0.4]]), np.array([0.0, 1.0]))
    origin, directions = np.array([0.0, 0, 2]), rays(2000, rng)
    distance = cast([], ground, origin, directions, 60.0).distance
    hit = np.isfinite(distance)
    ends = origin + distance[hit, None] * directions[hit]
    np.testing.assert_allclose(ends[:, 2], ground.height(ends[:, 0], ends[:, 1]), atol=1e-6)
    way = np.linspace(0, 0.999, 400)[:, None]
    over = [
        (point := origin + way * end * ray)[:, 2] > ground.height(point[:, 0], point[:, 1])
        for ray, end in zip(directions, np.where(hit, distance, 60), strict=True)
    ]
    assert np.mean(np.all(over, 1)) > 0.99  # a crest met by a grazing ray may be stepped over


def test_reach_ends_what_is_met():
    hits = cast([], Ground.flat(), np.array([0, 0, 2.0]), rays(500, np.random.default_rng(0)), 5.0)
    assert 2 <= hits.distance.min() <= hits.distance[np.isfinite(hits.distance)].max() <= 5


def test_a_mesh_s_depth_image_is_what_rays_meet():
    rng = np.random.default_rng(4)
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    triangles = mesh.triangles @ Rotation.random(random_state=rng).as_matrix().T + (0.1, -0.2, 4.0)
    across = np.linspace(-0.45, 0.4, 30)
    x, y = np.meshgrid(across, across)
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    met = triangles_met(triangles, np.zeros(3), directions).reshape(30, 30)
    np.testing.assert_allclose(depth_image(triangles, across), met, rtol=1e-9)
    assert 100 < np.isfinite(met).sum() < 800


def test_drilled_parts_are_met_where_material_begins():
    rng = np.random.default_rng(5)
    for _ in range(8):
        part = random_drilled(rng)

        def solid_at(points, part=part):
            made, drilled = (
                np.any([s.holds(points) for s in group] or [np.zeros(len(points), bool)], 0)
                for group in (part.solids, part.holes)
            )
            return made & ~drilled

        origin = 4 * rays(1, rng)[0]
        directions = -origin / 4 + 0.3 * rng.normal(size=(150, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = cast_drilled(part.solids, part.holes, origin, directions)
        for ray, end in zip(directions, distance, strict=True):
            way = np.linspace(0, min(end, 9) - 1e-6, 500)[:, None]
            assert not solid_at(origin + way * ray).any()
        hit = np.isfinite(distance)
        inside = solid_at(origin + (distance[hit] + 1e-6)[:, None] * directions[hit])
        assert inside.mean() > 0.99  # a ray may graze an edge


def test_samples_of_a_drilled_part_lie_between_material_and_air():
    rng = np.random.default_rng(6)
    for part in [random_drilled(rng) for _ in range(4)] + [random_flange(rng)[0]]:
        points = part.sample(2000, rng)
        assert points.shape == (2000, 3)
        nudged = [points + 1e-5 * rays(2000, rng) for _ in range(12)]
        made = np.mean([np.any([s.holds(p) for s in part.solids], 0) for p in nudged], 0)
        drilled = np.mean([np.any([s.holds(p) for s in part.holes] or [p[:, 0] > np.inf], 0) for p in nudged], 0)
        assert ((made > 0) & (drilled < 1)).mean() > 0.99
        assert ((made < 1) | (drilled > 0)).mean() > 0.99


# scenes


@scenes
def test_scans_of_a_scene_lie_on_it(family):
    rng = np.random.default_rng(0)
    scene = draw_scene(family, rng)
    for place in scene.places:
        directions = rays(3000, rng)
        distance = cast(scene.solids, scene.ground, place, directions, scene.reach).distance
        hit = np.isfinite(distance)
        assert hit.sum() > 300
        assert off_the_surface(scene, place + distance[hit, None] * directions[hit]).max() < 1e-6


@scenes
def test_scenery_has_the_symmetries_that_it_claims(family, monkeypatch):
    monkeypatch.setattr("idam.lab.data.scenes.how_many", lambda rng: 0)
    claimed = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = draw_scene(family, rng)
        directions = rays(1500, rng)
        distance = cast(scene.solids, scene.ground, scene.places[0], directions, scene.reach / 2).distance
        hit = np.isfinite(distance)
        points = scene.places[0] + distance[hit, None] * directions[hit]
        for symmetry in scene.symmetries:
            claimed += 1
            for steps in (1, -1) if symmetry.kind == "repeat" else (0.3, -1.7):
                assert off_the_surface(scene, apply(exp(steps * symmetry.twist), points)).max() < 1e-6
    assert claimed


# sensors


@pytest.mark.parametrize("kind", SENSORS)
def test_rays_are_unit_and_a_sensor_s_alone(kind):
    first, second = (draw_sensor(kind, np.random.default_rng(seed)) for seed in (0, 0))
    np.testing.assert_array_equal(first.directions, second.directions)
    np.testing.assert_allclose(np.linalg.norm(first.directions, axis=1), 1)
    assert 10_000 < len(first.directions) < 70_000


def test_a_spinning_lidar_has_rings_and_a_terrestrial_scanner_an_even_grid():
    for seed in range(5):
        rings = draw_sensor("spinning", np.random.default_rng(seed)).directions[:, 2].round(9)
        assert len(np.unique(rings)) in (16, 32, 40, 64, 128)
        upward = np.unique(np.arcsin(draw_sensor("terrestrial", np.random.default_rng(seed)).directions[:, 2]).round(9))
        np.testing.assert_allclose(np.diff(upward), np.diff(upward)[0], atol=1e-7)


def test_noise_range_and_dropout_are_as_they_say():
    rng = np.random.default_rng(0)
    sensor = Sensor("spinning", rays(20_000, rng), 1.0, 50.0, 0.02, dropout=0.1)
    measured = sensor.measure(np.full(20_000, 10.0), rng)
    assert np.isinf(measured).mean() == pytest.approx(0.1, abs=0.01)
    assert np.std(measured[np.isfinite(measured)]) == pytest.approx(0.02, rel=0.05)
    for out_of_range in (0.9, 51.0, np.inf):
        assert np.isinf(sensor.measure(np.full(20_000, out_of_range), rng)).all()


def test_a_camera_s_noise_grows_with_the_square_of_the_range_and_its_edges_bleed():
    rng = np.random.default_rng(0)
    sensor = Sensor("camera", rays(40_000, rng), 0.3, 9.0, 0.0, growth=0.002, image=100)
    measured = [sensor.measure(np.full(40_000, away), rng) for away in (1.0, 2.0, 4.0)]
    spread = [np.std(ranges[np.isfinite(ranges)]) for ranges in measured]
    np.testing.assert_allclose(spread, 0.002 * np.array([1.0, 4, 16]), rtol=0.05)
    step = np.where(np.arange(40_000) % 100 < 50, 2.0, 4.0)
    measured = [replace(sensor, growth=0.0).measure(step, rng) for _ in range(8)]
    between = [np.mean((m[np.isfinite(m)] > 2.01) & (m[np.isfinite(m)] < 3.99)) for m in measured]
    assert 0 < max(between) < 0.02
    assert np.isin(replace(sensor, growth=0.0, image=None).measure(step, rng), (2.0, 4.0, np.inf)).all()


# pairs


@pytest.fixture(scope="module")
def pairs() -> dict[str, list[SensorPair]]:
    return {name: [draw_sensor_pair(np.random.default_rng((9, n)), name) for n in range(4)] for name in FAMILIES}


@families
def test_a_pair_depends_on_the_generator_alone(family, pairs):
    np.random.seed(1)  # noqa: NPY002 - the one that must have no say
    again = draw_sensor_pair(np.random.default_rng((9, 0)), family)
    first, second = pairs[family][:2]
    np.testing.assert_array_equal(again.source, first.source)
    np.testing.assert_array_equal(again.target, first.target)
    np.testing.assert_array_equal(again.transformation, first.transformation)
    assert not np.array_equal(first.source, second.source)


@families
def test_pairs_are_large_enough_and_overlap(family, pairs):
    for pair in pairs[family]:
        assert pair.family == family
        assert FEWEST <= min(len(pair.source), len(pair.target)) <= max(len(pair.source), len(pair.target)) < 70_000
        assert LEAST_OVERLAP <= pair.overlap <= 1
        np.testing.assert_allclose(pair.transformation[:3, :3] @ pair.transformation[:3, :3].T, np.eye(3), atol=1e-12)


@families
def test_the_truth_lays_scans_on_each_other_and_free_motions_leave_them_there(family, pairs):
    for pair in pairs[family]:
        size = np.linalg.norm(pair.source - pair.source.mean(0), axis=1).mean()
        best = residual(pair, pair.transformation)
        assert best < 0.02 * size
        for symmetry in pair.free:
            # a half turn may take what one scan saw to where the other saw nothing
            if symmetry.kind != "repeat" or np.linalg.norm(symmetry.twist[:3]) < 1e-9:
                steps = 1.0 if symmetry.kind == "repeat" else 0.5
                moved = residual(pair, pair.transformation @ exp(steps * symmetry.twist))
                assert moved < 2.5 * best + 0.002 * size


def test_pairs_of_most_families_are_fixed_or_free():
    drawn = [draw_sensor_pair(np.random.default_rng((3, n))) for n in range(40)]
    assert 0.2 < np.mean([bool(pair.free) for pair in drawn]) < 0.7
    assert len({pair.family for pair in drawn}) > 8
    assert any(pair.sensors[0] != pair.sensors[1] for pair in drawn)
    assert {symmetry.kind for pair in drawn for symmetry in pair.free} == {"slide", "turn", "repeat"}


def test_what_both_scans_see_fixes_their_place():
    scene = SCENES["corridor"](np.random.default_rng(0))
    counts = np.array([[0, 5 * SEEN], [0, 4 * SEEN]])
    assert sensor_pairs._free(scene, counts, 10 * SEEN) == ()
    assert sensor_pairs._free(scene, 0 * counts, 10 * SEEN) == scene.symmetries
    # too few points to tell
    assert sensor_pairs._free(scene, counts // 10, 10 * SEEN) is None
    # an object that one scan alone sees leaves the slide, and tells repeats apart
    seen_once = sensor_pairs._free(scene, counts * [[1], [0]], 10 * SEEN)
    assert seen_once is not None
    assert {symmetry.kind for symmetry in seen_once} == {"slide"}


def test_an_object_unlike_scenery_moves_where_the_slide_is_taken():
    """Where a pair is fixed, the motions that scenery leaves free take objects off each other."""
    worse = []
    for seed in range(12):
        pair = draw_sensor_pair(np.random.default_rng((4, seed)), "corridor")
        if not pair.free:
            # its slide, in the source's frame, is along the corridor: the longest axis
            axis = np.linalg.svd(pair.source - pair.source.mean(0), full_matrices=False)[2][0]
            moved = pair.transformation @ exp(np.r_[0, 0, 0, 1.5 * axis])
            shares = [_close(pair, transformation) for transformation in (pair.transformation, moved)]
            worse.append(shares[0] - shares[1])
    assert len(worse) >= 3
    assert np.mean(np.array(worse) > 0) > 0.8


def _close(pair: SensorPair, transformation: np.ndarray) -> float:
    """Share of the source within 4 cm of the target."""
    return float(np.mean(cKDTree(pair.target).query(apply(transformation, pair.source))[0] < 0.04))


def test_overlap_is_the_smaller_share():
    half = np.random.default_rng(0).uniform(size=(400, 3))
    both = np.concatenate([half, half + np.array([5.0, 0, 0])])
    assert overlap_of(half, both, np.eye(4), 0.01) == 0.5
    assert overlap_of(both, half, np.eye(4), 0.01) == 0.5


def test_views_of_meshes_lie_on_the_whole():
    meshes = [trimesh.creation.torus(1.0, 0.4), trimesh.creation.capsule()]
    for seed in range(6):
        pair = draw_part_in_whole(np.random.default_rng(seed), meshes)
        assert sorted(pair.sensors) == ["camera", "model"]
        view, whole = pair.source, pair.target
        truth = pair.transformation
        if pair.sensors[0] == "model":
            view, whole, truth = whole, view, np.linalg.inv(truth)
        radius = np.linalg.norm(whole - whole.mean(0), axis=1).max()
        away = cKDTree(whole).query(apply(truth, view))[0]
        assert np.median(away) < 0.05 * radius
        assert len(view) >= FEWEST
