"""Rigid transforms: exponential and logarithm, inverse, adjoint, and how information is carried."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from motions import any_rotation
from motions import rotation as by_axis_and_angle

ANGLES = [0.0, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 3.0, np.pi - 1.1e-2, np.pi - 0.9e-2, np.pi - 1e-9]
"""Radians, on both sides of where series take over from quotients."""


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


def unit(random: np.random.Generator, count: int) -> np.ndarray:
    vectors = random.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def transforms(random: np.random.Generator, *shape: int) -> np.ndarray:
    rotations = np.array([any_rotation(random) for _ in range(int(np.prod(shape)))]).reshape(*shape, 3, 3)
    return rigid.transform(rotations, random.normal(size=(*shape, 3)))


def expm(matrix: np.ndarray) -> np.ndarray:
    """The matrix exponential by its series, after halving, and squaring again."""
    halvings = 8
    term = total = np.eye(len(matrix))
    for n in range(1, 20):
        term = term @ matrix / 2**halvings / n
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def generator(twist: np.ndarray) -> np.ndarray:
    """The 4x4 matrix whose exponential a twist's transform is."""
    x, y, z = twist[:3]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = twist[3:]
    return matrix


# --- points and matrices -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_apply_is_the_product_with_homogeneous_coordinates(random: np.random.Generator, shape: tuple[int, ...]) -> None:
    matrix = transforms(random, *shape) if shape else transforms(random, 1)[0]
    points = random.normal(size=(*shape, 7, 3))
    homogeneous = np.concatenate([points, np.ones((*shape, 7, 1))], -1)
    expected = np.einsum("...ij,...nj->...ni", matrix, homogeneous)[..., :3]
    np.testing.assert_allclose(rigid.apply(matrix, points), expected, atol=1e-14)


def test_many_transforms_move_one_cloud(random: np.random.Generator) -> None:
    matrices, points = transforms(random, 4), random.normal(size=(6, 3))
    expected = [rigid.apply(matrix, points) for matrix in matrices]
    np.testing.assert_allclose(rigid.apply(matrices, points), expected, atol=1e-15)


def test_inverse_undoes_in_either_order(random: np.random.Generator) -> None:
    matrices = transforms(random, 2, 3)
    matrices[..., :3, 3] *= 1e3
    back = rigid.inverse(matrices)
    for product in (back @ matrices, matrices @ back):
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), product.shape), atol=1e-11)
    np.testing.assert_array_equal(back[..., 3, :], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (2, 3, 4)))


def test_transform_broadcasts_rotations_and_translations(random: np.random.Generator) -> None:
    shifts = random.normal(size=(5, 3))
    matrices = rigid.transform(np.eye(3), shifts)
    assert matrices.shape == (5, 4, 4)
    np.testing.assert_array_equal(matrices[:, :3, 3], shifts)
    assert rigid.transform([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [1, 2, 3]).dtype == np.float64


def test_skew_is_the_cross_product(random: np.random.Generator) -> None:
    v, w = random.normal(size=(2, 9, 3))
    np.testing.assert_allclose((rigid.skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)


def test_nearest_rotation_is_nearer_than_others(random: np.random.Generator) -> None:
    for _ in range(10):
        exact = any_rotation(random)
        rough = exact + random.normal(0, 1e-2, (3, 3))
        found = rigid.nearest_rotation(rough)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) > 0
        distance = np.linalg.norm(found - rough)
        others = found @ rigid.rotation_exp(random.normal(0, 1e-3, (50, 3)))
        assert (np.linalg.norm(others - rough, axis=(1, 2)) > distance).all()
        np.testing.assert_allclose(rigid.nearest_rotation(exact), exact, atol=1e-14)


# --- exponential and logarithm -------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [*ANGLES, np.pi, 5.0])
def test_exp_is_the_matrix_exponential(random: np.random.Generator, angle: float) -> None:
    for axis in [*np.eye(3), *-np.eye(3), *unit(random, 5)]:
        twist = np.concatenate([angle * axis, random.normal(size=3)])
        np.testing.assert_allclose(rigid.exp(twist), expm(generator(twist)), atol=1e-13)
        np.testing.assert_allclose(rigid.rotation_exp(twist[:3]), by_axis_and_angle(twist[:3]), atol=1e-15)
        np.testing.assert_array_equal(rigid.exp(twist)[:3, :3], rigid.rotation_exp(twist[:3]))


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(random: np.random.Generator, angle: float) -> None:
    twists = np.concatenate([angle * unit(random, 50), random.normal(size=(50, 3))], 1)
    np.testing.assert_allclose(rigid.log(rigid.exp(twists)), twists, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_exp_undoes_log(random: np.random.Generator, angle: float) -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3), unit(random, 50)])
    matrices = rigid.transform(rigid.rotation_exp(angle * axes), random.normal(size=(len(axes), 3)))
    twists = rigid.log(matrices)
    np.testing.assert_allclose(rigid.exp(twists), matrices, atol=1e-12)
    assert (np.linalg.norm(twists[:, :3], axis=1) <= np.pi + 1e-15).all()


@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_angle_is_the_length_of_the_rotation_vector(random: np.random.Generator, angle: float) -> None:
    rotations = rigid.rotation_exp(angle * unit(random, 100)).reshape(20, 5, 3, 3)
    found = rigid.angle(rotations)
    assert found.shape == (20, 5)
    np.testing.assert_allclose(found, angle, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(rigid.angle(rigid.transform(rotations, [1e6, 0, 0])), found)


def test_the_least_rotation_between_two_is_symmetric_and_no_longer_than_a_detour(random: np.random.Generator) -> None:
    a, b, c = (transforms(random, 200)[:, :3, :3] for _ in range(3))

    def between(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return rigid.angle(x.swapaxes(-1, -2) @ y)

    np.testing.assert_allclose(between(a, b), between(b, a), atol=1e-12)
    assert (between(a, b) <= between(a, c) + between(c, b) + 1e-12).all()
    assert (between(a, b) <= np.pi).all()


# --- change of frame -----------------------------------------------------------------------------------------------


def test_adjoint_carries_a_twist_to_the_other_side(random: np.random.Generator) -> None:
    matrices, twists = transforms(random, 20), random.normal(size=(20, 6))
    carried = (rigid.adjoint(matrices) @ twists[..., None])[..., 0]
    np.testing.assert_allclose(rigid.exp(carried) @ matrices, matrices @ rigid.exp(twists), atol=1e-12)


def test_adjoint_of_a_product_is_the_product(random: np.random.Generator) -> None:
    a, b = transforms(random, 2, 10)
    np.testing.assert_allclose(rigid.adjoint(a @ b), rigid.adjoint(a) @ rigid.adjoint(b), atol=1e-13)
    np.testing.assert_allclose(rigid.adjoint(rigid.inverse(a)), np.linalg.inv(rigid.adjoint(a)), atol=1e-13)


def test_carried_information_costs_the_same(random: np.random.Generator) -> None:
    half, change, x = random.normal(size=(6, 6)), random.normal(size=(6, 6)), random.normal(size=6)
    information = half @ half.T
    carried = rigid.carried(information, change)
    np.testing.assert_array_equal(carried, carried.T)
    y = change @ x
    assert y @ carried @ y == pytest.approx(x @ information @ x, rel=1e-9)
    np.testing.assert_allclose(rigid.carried(carried, np.linalg.inv(change)), information, rtol=1e-6, atol=1e-9)
