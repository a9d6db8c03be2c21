"""Normals and FPFH: agreement with Open3D and with the paper's formulas, independence of pose, order and scale."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from idam.describe import fpfh as fpfh_module
from idam.describe.fpfh import fpfh
from idam.describe.normals import estimate_normals
from shapes import MOTION, SHAPES, degenerate_clouds, make_cloud, moved


def estimate(points: np.ndarray) -> np.ndarray:
    return estimate_normals(points, radius=0.1, max_neighbours=30)


def features_of(points: np.ndarray, scale: float = 1.0) -> np.ndarray:
    normals = estimate_normals(points, radius=0.1 * scale, max_neighbours=30)
    return fpfh(points, normals, radius=0.2 * scale, max_neighbours=100)


@pytest.fixture(scope="module")
def open3d() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import open3d
        except (ImportError, OSError) as error:  # OSError: a system library it needs is missing
            pytest.skip(f"Open3D does not import: {error}")
    return open3d


def as_open3d(open3d: ModuleType, points: np.ndarray, normals: np.ndarray | None = None) -> Any:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    return cloud


@pytest.mark.parametrize("max_neighbours", [100, 20])
@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("shape", SHAPES)
def test_agrees_with_open3d(open3d: ModuleType, shape: str, noise: float, max_neighbours: int) -> None:
    points = make_cloud(shape, noise=noise)
    normals = estimate(points)
    search = open3d.geometry.KDTreeSearchParamHybrid(0.2, max_neighbours)
    expected = open3d.pipelines.registration.compute_fpfh_feature(as_open3d(open3d, points, normals), search).data.T
    for dtype in (np.float32, np.float64):
        features = fpfh(points.astype(dtype), normals.astype(dtype), radius=0.2, max_neighbours=max_neighbours)
        difference = np.abs(features - expected).sum(-1) / np.abs(expected).sum(-1)
        assert np.corrcoef(features.ravel(), expected.ravel())[0, 1] >= 0.999
        assert np.median(difference) <= 0.01


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_agree_with_open3d_up_to_sign(open3d: ModuleType, shape: str) -> None:
    points = make_cloud(shape, count=2048, noise=0.005)
    cloud = as_open3d(open3d, points)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(0.1, 30))
    cosine = np.abs((estimate(points) * np.asarray(cloud.normals)).sum(-1))
    enough = (np.linalg.norm(points[:, None] - points, axis=-1) < 0.1).sum(-1) >= 3
    np.testing.assert_allclose(cosine[enough], 1, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_the_eigenvectors_of_least_variance(shape: str) -> None:
    points = make_cloud(shape, count=500, noise=0.005)
    for point, normal in zip(points, estimate(points), strict=True):
        distance = np.linalg.norm(points - point, axis=1)
        near = points[distance.argsort()[: max(3, min(30, (distance < 0.1).sum()))]]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        if values[1] > 1e-3 * values[2]:  # not a line
            assert abs(normal @ vectors[:, 0]) == pytest.approx(1, abs=1e-6)


def reference_fpfh(points: np.ndarray, normals: np.ndarray, radius: float, max_neighbours: int) -> np.ndarray:
    """The formulas of the paper, one pair at a time."""
    neighbours = []
    for i, point in enumerate(points):
        distance = np.linalg.norm(points - point, axis=1)
        others = [j for j in np.argsort(distance) if j != i and distance[j] < radius]
        neighbours.append([(j, distance[j]) for j in others[: max_neighbours - 1]])
    spfh = np.zeros((len(points), 3, 11))
    for i, pairs in enumerate(neighbours):
        for j, distance in pairs:
            for histogram, (angle, low, high) in zip(spfh[i], reference_angles(points, normals, i, j), strict=True):
                position = 11 * (angle - low) / (high - low) if distance else 5.5
                histogram[min(int(position), 10)] += 100 / len(pairs)
    features = spfh.copy()
    for i, pairs in enumerate(neighbours):
        weights = {j: 1 / distance**2 for j, distance in pairs if distance}
        for j, weight in weights.items():
            features[i] += weight / sum(weights.values()) * spfh[j]
    flat: np.ndarray = features.reshape(-1, 33)
    return flat


def reference_angles(points: np.ndarray, normals: np.ndarray, i: int, j: int) -> list[tuple[float, float, float]]:
    """Theta, phi and alpha of a pair, each with its range."""
    line = (points[j] - points[i]) / max(np.linalg.norm(points[j] - points[i]), 1e-300)
    u, n = normals[i], normals[j]
    if abs(u @ line) < abs(n @ line):
        u, n, line = n, u, -line
    v = np.cross(line, u)
    v /= max(np.linalg.norm(v), 1e-300)
    w = np.cross(u, v)
    return [(np.arctan2(w @ n, u @ n), -np.pi, np.pi), (v @ n, -1, 1), (u @ line, -1, 1)]


@pytest.mark.parametrize(("max_neighbours", "duplicates"), [(100, 5), (8, 0)])
def test_agrees_with_the_formulas(monkeypatch: pytest.MonkeyPatch, max_neighbours: int, duplicates: int) -> None:
    monkeypatch.setattr(fpfh_module, "TIE", 1e-12)
    points = make_cloud("torus", 150, noise=0.02)
    points = np.concatenate([points, points[:duplicates]])
    # normals in all directions, not a smooth surface's: every bin is visited
    normals = np.random.default_rng(0).standard_normal(points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    features = fpfh(points, normals, radius=0.3, max_neighbours=max_neighbours)
    assert (features > 0).any(0).all()
    np.testing.assert_allclose(features, reference_fpfh(points, normals, 0.3, max_neighbours), atol=1e-9)


def test_each_angle_adds_up_to_200_percent() -> None:
    features = features_of(make_cloud("box"))
    assert features.shape == (768, 33)
    np.testing.assert_allclose(features.reshape(-1, 3, 11).sum(-1), 200)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-6), (np.float32, 1e-2)])
@pytest.mark.parametrize("shape", SHAPES)
def test_rotation_and_translation_change_nothing(shape: str, dtype: type, tolerance: float) -> None:
    points = make_cloud(shape)
    before, after = features_of(points.astype(dtype)), features_of(moved(points).astype(dtype))
    assert before.dtype == dtype
    # in float32 a few neighbours change sides of the radius or of a bin
    changed = (np.abs(before - after) > tolerance).any(-1)
    assert changed.mean() <= (0 if dtype == np.float64 else 0.02)


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_turn_with_the_cloud(shape: str) -> None:
    points = make_cloud(shape)
    np.testing.assert_allclose(estimate(moved(points)), estimate(points) @ MOTION[:3, :3].T, atol=1e-6)


def test_permuting_the_points_permutes_the_features() -> None:
    points = make_cloud("torus")
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_allclose(features_of(points[order]), features_of(points)[order], atol=1e-9)


def test_scale_is_the_radius() -> None:
    points = make_cloud("torus")
    np.testing.assert_allclose(features_of(1000 * points, 1000), features_of(points), atol=1e-6)


def test_normals_of_a_sphere_point_outward() -> None:
    points = make_cloud("sphere", 2048)
    cosine = (estimate(points) * points / 0.6).sum(-1)
    assert np.median(cosine) > 0.99
    assert (cosine > 0.5).mean() > 0.99


def test_points_of_a_plane_agree_on_a_normal() -> None:
    # through the centroid, where neither side is outward
    plane = np.random.default_rng(0).random((500, 3)) * (1, 1, 0)
    normals = estimate(moved(plane))
    np.testing.assert_allclose(normals, np.broadcast_to(normals[:1], normals.shape), atol=1e-7)


def test_a_point_without_neighbours_has_a_normal_and_no_histogram() -> None:
    points = np.concatenate([make_cloud("torus", 200), np.full((1, 3), 5.0)])
    assert np.linalg.norm(estimate(points)[-1]) == pytest.approx(1)
    assert not features_of(points)[-1].any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", [*degenerate_clouds(), "one point"])
def test_degenerate_clouds_have_finite_features(name: str, dtype: type) -> None:
    points = (degenerate_clouds() | {"one point": np.ones((1, 3))})[name].astype(dtype)
    normals, features = estimate(points), features_of(points)
    assert features.dtype == normals.dtype == dtype
    assert np.isfinite(features).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("name", ["one place", "line", "plane"])
def test_degenerate_clouds_too_have_the_same_features_in_every_pose(name: str) -> None:
    points = degenerate_clouds()[name]
    np.testing.assert_allclose(features_of(moved(points)), features_of(points), atol=1e-6)
