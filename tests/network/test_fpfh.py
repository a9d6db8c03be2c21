"""FPFH: agreement with Open3D and with the paper's formulas, independence of pose, order, batch and chunks."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch.testing import assert_close

from idam.network.features import fpfh as fpfh_module
from idam.network.features.fpfh import FPFH, estimate_normals, fpfh
from idam.network.features.normals import Reach, find_neighbours
from idam.network.geometry import apply_transform, random_rotation

SHAPES = ["sphere", "torus", "capsule", "box", "plate"]
TRANSLATION = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)


def make_mesh(shape: str) -> Any:
    if shape == "sphere":
        return trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    if shape == "torus":
        return trimesh.creation.torus(major_radius=0.7, minor_radius=0.25)
    if shape == "capsule":
        return trimesh.creation.capsule(height=1.0, radius=0.3)
    # opposite faces within reach of each other: many pairs of parallel normals
    return trimesh.creation.box((1.0, 0.8, 0.6) if shape == "box" else (1.2, 0.9, 0.1))


def make_cloud(shape: str, count: int = 768, noise: float = 0.0) -> Tensor:
    """One cloud (1, N, 3), float64, sampled from a surface."""
    points, _ = trimesh.sample.sample_surface(make_mesh(shape), count, seed=0)
    points = np.asarray(points) + noise * np.random.default_rng(1).standard_normal((count, 3))
    return torch.from_numpy(points).unsqueeze(0)


def make_rotation() -> Tensor:
    return random_rotation(1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def estimate(points: Tensor) -> Tensor:
    return estimate_normals(points, radius=0.1, max_neighbours=30)


@pytest.fixture(scope="module")
def open3d() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import open3d
        except (ImportError, OSError) as error:  # OSError: a system library it needs is missing
            pytest.skip(f"Open3D does not import: {error}")
    return open3d


def as_open3d(open3d: ModuleType, points: Tensor, normals: Tensor | None = None) -> Any:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.numpy()))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals.numpy())
    return cloud


@pytest.mark.parametrize("max_neighbours", [100, 20])
@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("shape", SHAPES)
def test_agrees_with_open3d(open3d: ModuleType, shape: str, noise: float, max_neighbours: int) -> None:
    points = make_cloud(shape, noise=noise)
    normals = estimate(points)
    search = open3d.geometry.KDTreeSearchParamHybrid(0.2, max_neighbours)
    reference = open3d.pipelines.registration.compute_fpfh_feature(as_open3d(open3d, points[0], normals[0]), search)
    expected = torch.tensor(reference.data.T)
    for dtype in (torch.float32, torch.float64):
        features = fpfh(points.to(dtype), normals.to(dtype), radius=0.2, max_neighbours=max_neighbours)[0]
        difference = (features - expected).abs().sum(-1) / expected.abs().sum(-1)
        assert np.corrcoef(features.flatten(), expected.flatten())[0, 1] >= 0.999
        assert difference.median() <= 0.01


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_agree_with_open3d_up_to_sign(open3d: ModuleType, shape: str) -> None:
    points = make_cloud(shape, count=2048, noise=0.005)
    cloud = as_open3d(open3d, points[0])
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(0.1, 30))
    cosine = (estimate(points)[0] * torch.tensor(np.asarray(cloud.normals))).sum(-1).abs()
    enough = (torch.cdist(points[0], points[0]) < 0.1).sum(-1) >= 3
    assert_close(cosine[enough], torch.ones_like(cosine[enough]), atol=1e-6, rtol=0)


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
    points = torch.cat([points, points[:, :duplicates]], 1)
    # normals in all directions, not a smooth surface's: every bin is visited
    normals = torch.randn(points.shape, generator=torch.Generator().manual_seed(0), dtype=points.dtype)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    features = fpfh(points, normals, radius=0.3, max_neighbours=max_neighbours)[0]
    assert (features > 0).any(0).all()
    assert_close(features.numpy(), reference_fpfh(points[0].numpy(), normals[0].numpy(), 0.3, max_neighbours))


def test_each_angle_adds_up_to_200_percent() -> None:
    features = FPFH()(make_cloud("box"))
    assert FPFH.channels == features.shape[-1] == 33
    sums = features.unflatten(-1, (3, 11)).sum(-1)
    assert_close(sums, torch.full_like(sums, 200))


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-2)], ids=["float64", "float32"]
)
@pytest.mark.parametrize("shape", SHAPES)
def test_rotation_and_translation_change_nothing(shape: str, dtype: torch.dtype, tolerance: float) -> None:
    points = make_cloud(shape)
    moved = apply_transform(points, make_rotation(), TRANSLATION)
    before, after = FPFH()(points.to(dtype)), FPFH()(moved.to(dtype))
    # in float32 a few neighbours change sides of the radius or of a bin
    changed = ((before - after).abs() > tolerance).any(-1)
    assert changed.double().mean() <= (0 if dtype == torch.float64 else 0.02)


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_turn_with_the_cloud(shape: str) -> None:
    points, rotation = make_cloud(shape), make_rotation()
    moved = apply_transform(points, rotation, TRANSLATION)
    assert_close(estimate(moved), estimate(points) @ rotation.mT, atol=1e-6, rtol=0)


def test_permuting_the_points_permutes_the_features() -> None:
    points = make_cloud("capsule")
    order = torch.randperm(points.shape[1], generator=torch.Generator().manual_seed(0))
    assert_close(FPFH()(points[:, order]), FPFH()(points)[:, order])


def test_scale_is_the_radius() -> None:
    points = make_cloud("torus")
    scaled = FPFH(normal_radius=100, feature_radius=200)(1000 * points)
    assert_close(scaled, FPFH()(points), atol=1e-6, rtol=0)


def test_batch_equals_one_by_one() -> None:
    clouds = torch.cat([make_cloud(shape) for shape in SHAPES])
    assert_close(FPFH()(clouds), torch.cat([FPFH()(cloud) for cloud in torch.split(clouds, 1)]), rtol=0, atol=0)


def test_neighbours_are_those_of_all_distances() -> None:
    points = make_cloud("box", 300)
    square = torch.cdist(points[0], points[0], compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(torch.inf)
    for reach in (Reach(0.3, at_most=8), Reach(0.3, at_most=1000), Reach(0.05, at_most=20, at_least=2)):
        (near,) = find_neighbours(points, reach)
        for row, distance in enumerate(square):
            within = int((distance < reach.radius).sum())
            expected = distance.argsort()[: min(max(within, reach.at_least), reach.at_most)]
            assert near.neighbour[near.centre == row].tolist() == expected.tolist()
        assert near.counts.tolist() == near.centre.bincount(minlength=300).tolist()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_points_that_are_no_numbers_are_told(value: float) -> None:
    points = make_cloud("box", 100)
    points[0, 3, 1] = value
    with pytest.raises(ValueError, match="must be finite"):
        FPFH()(points)


def test_module_is_normals_then_features() -> None:
    points = make_cloud("box")
    expected = fpfh(points, estimate(points), radius=0.2, max_neighbours=100)
    assert_close(FPFH()(points), expected, rtol=0, atol=0)


def test_normals_of_a_sphere_point_outward() -> None:
    points = make_cloud("sphere", 2048)
    cosine = (estimate(points) * torch.nn.functional.normalize(points, dim=-1)).sum(-1)
    assert cosine.median() > 0.99
    assert (cosine > 0.5).double().mean() > 0.99


def test_points_of_a_plane_agree_on_a_normal() -> None:
    # through the centroid, where neither side is outward
    plane = torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plane[..., 2] = 0
    normals = estimate(apply_transform(plane, make_rotation(), TRANSLATION))
    assert_close(normals, normals[:, :1].expand_as(normals))


def test_a_point_without_neighbours_has_a_normal_and_no_histogram() -> None:
    points = torch.cat([make_cloud("torus", 200), torch.full((1, 1, 3), 5.0, dtype=torch.float64)], 1)
    assert_close(estimate(points)[0, -1].norm(), torch.tensor(1.0, dtype=torch.float64))
    assert not FPFH()(points)[0, -1].any()


def degenerate_clouds() -> dict[str, Tensor]:
    uniform = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    return {
        "one place": torch.ones(300, 3),
        "line": uniform[:, :1] * torch.tensor([0.3, 0.5, 0.8]),
        "axis-parallel line": uniform * torch.tensor([1.0, 0, 0]),
        "plane": uniform * torch.tensor([1.0, 1.0, 0]),
        "lattice": torch.cartesian_prod(*3 * [torch.arange(6) / 10]),
        "duplicates": uniform[:20].repeat(15, 1),
        "nearly duplicates": torch.cat([uniform[:100] * 1e-21, uniform[:100]]),
        "nothing within reach": 100 * uniform,
        "far away": uniform + 1e4,
        "one point": uniform[:1],
        "two points": uniform[:2],
    }


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("name", degenerate_clouds())
def test_degenerate_input_gives_finite_features(name: str, dtype: torch.dtype) -> None:
    points = degenerate_clouds()[name].to(dtype).unsqueeze(0)
    normals, features = estimate(points), FPFH()(points)
    assert features.dtype == normals.dtype == dtype
    assert features.isfinite().all()
    assert_close(normals.norm(dim=-1).float(), torch.ones(points.shape[:2]), atol=1e-2, rtol=0)


@pytest.mark.parametrize("name", ["one place", "line", "plane"])
def test_degenerate_input_too_has_the_same_features_in_every_pose(name: str) -> None:
    points = degenerate_clouds()[name].double().unsqueeze(0)
    moved = apply_transform(points, make_rotation(), TRANSLATION)
    assert_close(FPFH()(moved), FPFH()(points), atol=1e-6, rtol=0)


def test_autocast_changes_nothing() -> None:
    points = make_cloud("capsule").float()
    with torch.autocast("cpu", torch.bfloat16):
        features = FPFH()(points)
    assert_close(features, FPFH()(points), rtol=0, atol=0)


def test_needs_no_gradient() -> None:
    assert not FPFH()(make_cloud("box").requires_grad_()).requires_grad


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_gpu_equals_cpu() -> None:
    clouds = torch.cat([make_cloud(shape) for shape in SHAPES])
    assert_close(FPFH()(clouds.cuda()).cpu(), FPFH()(clouds), atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(100, 3), (2, 100, 4), (0, 100, 3), (2, 0, 3)])
def test_refuses_what_is_not_a_batch_of_clouds(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(B, N, 3\)"):
        FPFH()(torch.zeros(shape))
