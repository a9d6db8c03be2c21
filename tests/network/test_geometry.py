"""Rigid transforms against explicit matrices and SciPy; weighted Procrustes; nearest neighbours by brute force."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from torch import Tensor

from idam.network.geometry import (
    apply_transform,
    compose,
    euler_xyz_to_rotation,
    gather_points,
    invert,
    nearest,
    nearest_neighbours,
    random_rotation,
    rotation_angle,
    rotation_to_euler_zyx,
    rotations_within,
    square_distance,
    weighted_procrustes,
)


@pytest.fixture
def transform(randn, generator, dtype):
    """Makes random transforms with a leading shape."""

    def make(*shape: int) -> tuple[Tensor, Tensor]:
        rotation = random_rotation(math.prod(shape), generator=generator, dtype=dtype)
        return rotation.view(*shape, 3, 3), randn(*shape, 3, dtype=dtype)

    return make


def axis_rotations(angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rx(a), Ry(b), Rz(c), each written out, for one triple of angles."""
    (ca, cb, cc), (sa, sb, sc) = angles.cos(), angles.sin()
    return (
        angles.new_tensor([[1, 0, 0], [0, ca, -sa], [0, sa, ca]]),
        angles.new_tensor([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]),
        angles.new_tensor([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]]),
    )


def zyx(z: float, y: float, x: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rz(z) Ry(y) Rx(x) of angles in degrees, made in float64."""
    rx, ry, rz = axis_rotations(torch.tensor([x, y, z], dtype=torch.float64).deg2rad())
    return (rz @ ry @ rx).to(dtype)


# transforms


def test_apply_transform_is_r_p_plus_t(transform, randn, dtype, close):
    rotation, translation = transform(2, 3)
    points = randn(2, 3, 7, 3, dtype=dtype)
    moved = apply_transform(points, rotation, translation)
    for b in np.ndindex(2, 3):
        for n in range(7):
            close(moved[b][n], rotation[b] @ points[b][n] + translation[b])


def test_compose_applies_the_first_then_the_second(transform, randn, dtype, close):
    first, second = transform(2, 3), transform(2, 3)
    points = randn(2, 3, 7, 3, dtype=dtype)
    close(apply_transform(points, *compose(*second, *first)), apply_transform(apply_transform(points, *first), *second))


def test_compose_is_the_product_of_homogeneous_matrices(transform, dtype, close):
    def matrix(rotation, translation):
        top = torch.cat([rotation, translation[:, None]], 1)
        return torch.cat([top, torch.tensor([[0, 0, 0, 1]], dtype=dtype)])

    first, second = transform(), transform()
    close(matrix(*compose(*second, *first)), matrix(*second) @ matrix(*first))


def test_a_transform_and_its_inverse_cancel_on_either_side(transform, dtype, close):
    direct = transform(4)
    inverse = invert(*direct)
    for rotation, translation in (compose(*direct, *inverse), compose(*inverse, *direct)):
        close(rotation, torch.eye(3, dtype=dtype).expand(4, 3, 3))
        close(translation, torch.zeros(4, 3, dtype=dtype))


# rotations


def test_euler_xyz_is_rx_ry_rz(randn, dtype, close):
    angles = randn(2, 5, 3, dtype=dtype) * 3
    rotation = euler_xyz_to_rotation(angles)
    for b in np.ndindex(2, 5):
        rx, ry, rz = axis_rotations(angles[b])
        close(rotation[b], rx @ ry @ rz)


def test_euler_xyz_gives_rotations(randn, dtype, assert_rotations):
    assert_rotations(euler_xyz_to_rotation(randn(50, 3, dtype=dtype) * 3))


def test_zyx_angles_come_back_from_their_rotation(rand, dtype):
    angles = (rand(50, 3) * 2 - 1) * torch.tensor([179.0, 85.0, 179.0])
    rotation = torch.stack([zyx(*triple.tolist(), dtype) for triple in angles])
    tolerance = 1e-3 if dtype == torch.float32 else 1e-10
    torch.testing.assert_close(rotation_to_euler_zyx(rotation).double(), angles, rtol=0, atol=tolerance)


def test_zyx_angles_agree_with_scipy(generator):
    rotation = random_rotation(100, generator=generator, dtype=torch.float64)
    expected = Rotation.from_matrix(rotation.numpy()).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(rotation_to_euler_zyx(rotation), expected, atol=1e-9)


@pytest.mark.parametrize("y", [90.0, -90.0])
def test_at_gimbal_lock_x_carries_the_whole_turn(y, dtype, close):
    for z, x in [(0, 0), (30, 0), (0, -70), (120, 50), (-170, 165)]:
        rotation = zyx(z, y, x, dtype)
        angles = rotation_to_euler_zyx(rotation)
        assert angles[0] == 0
        close(zyx(*angles.tolist(), dtype), rotation)


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 1e-3, 1.0, 90.0, 179.0, 179.999, 180.0])
def test_rotation_angle_is_accurate_from_0_to_180(degrees, randn, dtype):
    axis = randn(20, 3)
    turn = math.radians(degrees) * axis / axis.norm(dim=-1, keepdim=True)
    rotation = torch.from_numpy(Rotation.from_rotvec(turn.numpy()).as_matrix()).to(dtype)
    # a rounding of the entries by e turns a rotation by about e; for small angles the entries are relatively exact
    relative, rounding = (1e-6, 3e-5) if dtype == torch.float32 else (1e-9, 1e-13)
    tolerance = relative * degrees if degrees < 1 else rounding
    expected = torch.full((20,), degrees, dtype=torch.float64)
    torch.testing.assert_close(rotation_angle(rotation).double(), expected, rtol=0, atol=tolerance)


def test_rotation_angle_of_a_batch_shape(generator):
    rotation = random_rotation(6, generator=generator)
    assert torch.equal(rotation_angle(rotation.view(2, 3, 3, 3)).flatten(), rotation_angle(rotation))


def test_random_rotations_are_rotations(generator, dtype, assert_rotations):
    rotation = random_rotation(100, generator=generator, dtype=dtype)
    assert rotation.dtype == dtype
    assert_rotations(rotation)


def test_random_rotations_are_uniform(generator):
    rotation = random_rotation(4000, generator=generator, dtype=torch.float64)
    # every entry has mean 0 and variance 1/3, and the angle has the density (1 - cos a) / pi
    assert rotation.mean(0).abs().max() < 5 / math.sqrt(3 * 4000)
    assert (rotation.square().mean(0) - 1 / 3).abs().max() < 5 * 0.3 / math.sqrt(4000)
    angle = rotation_angle(rotation).deg2rad().numpy()
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01


def test_random_rotations_follow_their_generator():
    one, same, other = (random_rotation(3, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


# weighted Procrustes


def weighted_cost(source: Tensor, target: Tensor, weight: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    residual = apply_transform(source, rotation, translation) - target
    return (weight * residual.square().sum(-1)).sum(-1)


def procrustes_by_scipy(source: Tensor, target: Tensor, weight: Tensor) -> tuple[np.ndarray, np.ndarray]:
    p, q, w = (x.numpy() for x in (source, target, weight))
    p_mean, q_mean = np.average(p, axis=0, weights=w), np.average(q, axis=0, weights=w)
    rotation = Rotation.align_vectors(q - q_mean, p - p_mean, weights=w)[0].as_matrix()
    return rotation, q_mean - rotation @ p_mean


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
@pytest.mark.parametrize("count", [3, 20])
def test_procrustes_recovers_the_transform_of_any_batch_shape(shape, count, transform, randn, rand, dtype, close):
    rotation, translation = transform(*shape)
    source, weight = randn(*shape, count, 3, dtype=dtype), rand(*shape, count, dtype=dtype) + 0.1
    estimate = weighted_procrustes(source, apply_transform(source, rotation, translation), weight)
    close(estimate[0], rotation)
    close(estimate[1], translation)


def test_procrustes_ignores_outliers_of_no_weight(transform, randn, rand, dtype, close):
    rotation, translation = transform(3)
    source, weight = randn(3, 20, 3, dtype=dtype), rand(3, 20, dtype=dtype) + 0.1
    target = apply_transform(source, rotation, translation)
    target[:, 8:] += 5 + randn(3, 12, 3, dtype=dtype)
    weight[:, 8:] = 0
    estimate = weighted_procrustes(source, target, weight)
    close(estimate[0], rotation)
    close(estimate[1], translation)


def test_procrustes_agrees_with_scipy_on_weighted_data_that_fit_no_transform(randn, rand):
    source, target, weight = randn(10, 15, 3) + 1, randn(10, 15, 3) - 2, rand(10, 15) ** 4
    weight[:, ::3] = 0
    rotation, translation = weighted_procrustes(source, target, weight)
    for b in range(10):
        expected = procrustes_by_scipy(source[b], target[b], weight[b])
        np.testing.assert_allclose(rotation[b], expected[0], atol=1e-10)
        np.testing.assert_allclose(translation[b], expected[1], atol=1e-10)


def test_no_transform_nearby_has_a_lower_weighted_cost(randn, rand):
    source, target, weight = randn(15, 3), randn(15, 3), rand(15) ** 4
    rotation, translation = weighted_procrustes(source, target, weight)
    best = weighted_cost(source, target, weight, rotation, translation)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        turns, shifts = euler_xyz_to_rotation(size * randn(200, 3)), size * randn(200, 3)
        assert (weighted_cost(source, target, weight, turns @ rotation, translation + shifts) >= best).all()


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e30])
def test_procrustes_takes_weights_of_any_scale(scale, randn, rand, dtype, close):
    source, target, weight = randn(15, 3, dtype=dtype), randn(15, 3, dtype=dtype), rand(15, dtype=dtype)
    for scaled, plain in zip(
        weighted_procrustes(source, target, scale * weight), weighted_procrustes(source, target, weight), strict=True
    ):
        close(scaled, plain)


def test_moving_the_target_moves_the_solution_along(transform, randn, rand, dtype, close):
    source, target, weight = randn(15, 3, dtype=dtype), randn(15, 3, dtype=dtype), rand(15, dtype=dtype)
    move = transform()
    estimate = weighted_procrustes(source, apply_transform(target, *move), weight)
    expected = compose(*move, *weighted_procrustes(source, target, weight))
    close(estimate[0], expected[0])
    close(estimate[1], expected[1])


def test_mirrored_data_still_gets_the_best_proper_rotation(randn, rand, dtype, assert_rotations):
    source, weight = randn(5, 20, 3, dtype=dtype), rand(5, 20, dtype=dtype)
    target = source * torch.tensor([1, 1, -1], dtype=dtype)
    rotation, _ = weighted_procrustes(source, target, weight)
    assert_rotations(rotation)
    for b in range(5):
        expected, _ = procrustes_by_scipy(source[b].double(), target[b].double(), weight[b].double())
        np.testing.assert_allclose(rotation[b], expected, atol=1e-4 if dtype == torch.float32 else 1e-10)


DEGENERATE = {
    "no weight": lambda p, q, w: (p, q, 0 * w),
    "a single weight": lambda p, q, w: (p, q, w * (torch.arange(10) == 4)),
    "two weights": lambda p, q, w: (p, q, w * (torch.arange(10) < 2)),
    "collinear source": lambda p, q, w: (p[..., :1] * p[..., :1, :], q, w),
    "collinear clouds": lambda p, q, w: (p[..., :1] * p[..., :1, :], p[..., :1] * q[..., :1, :], w),
    "coplanar clouds": lambda p, q, w: (p * p.new_tensor([1, 1, 0]), q * p.new_tensor([1, 0, 1]), w),
    "one target point": lambda p, q, w: (p, q[..., :1, :].expand_as(p), w),
    "coincident clouds": lambda p, q, w: (p[..., :1, :].expand_as(p), q[..., :1, :].expand_as(p), w),
    "all zero": lambda p, q, w: (0 * p, 0 * q, 0 * w),
    "one point": lambda p, q, w: (p[..., :1, :], q[..., :1, :], w[..., :1]),
}


@pytest.mark.parametrize("degrade", DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_data_give_a_finite_rotation(degrade, randn, rand, dtype, assert_rotations):
    data = degrade(randn(8, 10, 3, dtype=dtype), randn(8, 10, 3, dtype=dtype), rand(8, 10, dtype=dtype) + 0.1)
    rotation, translation = weighted_procrustes(*data)
    assert translation.isfinite().all()
    assert_rotations(rotation)


def test_no_weight_counts_as_equal_weights(randn, dtype, close):
    source, target = randn(4, 10, 3, dtype=dtype), randn(4, 10, 3, dtype=dtype)
    weight = torch.ones(4, 10, dtype=dtype)
    weight[::2] = 0
    for estimate, expected in zip(
        weighted_procrustes(source, target, weight),
        weighted_procrustes(source, target, torch.ones_like(weight)),
        strict=True,
    ):
        close(estimate, expected)


def test_a_single_match_is_met_exactly(randn, dtype, close):
    source, target = randn(10, 3, dtype=dtype), randn(10, 3, dtype=dtype)
    rotation, translation = weighted_procrustes(source, target, (torch.arange(10) == 4).to(dtype))
    close(rotation @ source[4] + translation, target[4])


def test_collinear_points_are_laid_on_their_matches(transform, randn, rand, dtype, close):
    source = randn(10, 1, dtype=dtype) * randn(3, dtype=dtype) + randn(3, dtype=dtype)
    target = apply_transform(source, *transform())
    estimate = weighted_procrustes(source, target, rand(10, dtype=dtype) + 0.1)
    close(apply_transform(source, *estimate), target)


def test_procrustes_passes_gradcheck(randn, rand):
    inputs = randn(2, 6, 3), randn(2, 6, 3), rand(2, 6) + 0.1
    assert torch.autograd.gradcheck(weighted_procrustes, [x.requires_grad_() for x in inputs])


# nearest neighbours


def distances(a: Tensor, b: Tensor) -> Tensor:
    return (a.unsqueeze(-2) - b.unsqueeze(-3)).norm(dim=-1)


def test_square_distance_is_by_definition(randn, dtype, close):
    a, b = randn(2, 3, 9, 3, dtype=dtype), randn(2, 3, 5, 3, dtype=dtype)
    close(square_distance(a, b), distances(a, b).square())


def test_square_distance_is_never_negative(randn):
    points = randn(200, 3, dtype=torch.float32) + 10
    assert (square_distance(points, points) >= 0).all()


def test_nearest_neighbours_agree_with_brute_force(randn, dtype):
    points = randn(2, 40, 3, dtype=dtype)
    index = nearest_neighbours(points, 6)
    assert index.shape == (2, 40, 6)
    for cloud, rows in zip(points, index, strict=True):
        for i in range(40):
            expected = sorted((float((cloud[i] - cloud[j]).norm()), j) for j in range(40) if j != i)[:6]
            assert rows[i].tolist() == [j for _, j in expected]


def test_no_point_is_its_own_neighbour_even_among_its_copies(randn, dtype):
    points = randn(1, 5, 3, dtype=dtype).repeat(1, 4, 1)
    index = nearest_neighbours(points, 3)[0]
    for i in range(20):
        assert set(index[i].tolist()) == {j for j in range(20) if j % 5 == i % 5} - {i}


def test_nearest_agrees_with_brute_force(randn, dtype, close):
    query, points = randn(3, 30, 3, dtype=dtype), randn(3, 17, 3, dtype=dtype)
    distance, index = nearest(query, points)
    expected, expected_index = distances(query, points).min(-1)
    close(distance, expected.square())
    assert torch.equal(index, expected_index)


def test_gather_points_takes_rows_of_each_cloud(randn, generator):
    values, index = randn(3, 10, 4), torch.randint(10, (3, 6), generator=generator)
    gathered = gather_points(values, index)
    for b in range(3):
        assert torch.equal(gathered[b], values[b][index[b]])


@pytest.mark.parametrize("degrees", [75, 180])
def test_rotations_are_uniform_up_to_the_largest_angle(degrees, generator):
    angles = rotation_angle(rotations_within(20_000, math.radians(degrees), generator)).double().sort().values
    angles = torch.deg2rad(angles) if angles.max() > math.pi else angles
    limit = math.radians(degrees)
    expected = (angles - angles.sin()) / (limit - math.sin(limit))
    assert angles.max() <= limit + 1e-3
    assert (expected - torch.linspace(0, 1, 20_000, dtype=torch.float64)).abs().max() < 0.02
