"""Errors against NumPy and SciPy; wrapping; recall."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from idam.lab.data.practice import fixed_practice_pairs
from idam.lab.evaluation.metrics import CHUNK, Metrics, measure, modified_chamfer
from idam.network.geometry import random_rotation


def about_z(*degrees: float) -> Tensor:
    return torch.from_numpy(Rotation.from_euler("Z", np.array(degrees)[:, None], degrees=True).as_matrix())


@pytest.fixture
def truth(generator, randn) -> tuple[Tensor, Tensor]:
    return random_rotation(30, generator=generator, dtype=torch.float64), randn(30, 3)


def measured_by_scipy(estimate: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> dict[str, float]:
    """The figures of section 4, in a loop over pairs, angles and coordinates."""
    angle_errors, offset_errors, right, turns, lengths = [], [], [], [], []
    for rotation, translation, true_rotation, true_translation in zip(*estimate, *truth, strict=True):
        turn, true_turn = Rotation.from_matrix(rotation.numpy()), Rotation.from_matrix(true_rotation.numpy())
        for a, b in zip(turn.as_euler("ZYX", degrees=True), true_turn.as_euler("ZYX", degrees=True), strict=True):
            angle_errors.append(min(abs(a - b), 360 - abs(a - b)))
        offset = (translation - true_translation).numpy()
        offset_errors += list(np.abs(offset))
        isotropic = np.rad2deg((true_turn * turn.inv()).magnitude())
        turns.append(isotropic)
        lengths.append(np.linalg.norm(offset))
        right.append(isotropic <= 5 and np.linalg.norm(offset) <= 0.05)
    return {
        "rmse_r": np.sqrt(np.mean(np.square(angle_errors))),
        "mae_r": np.mean(angle_errors),
        "rmse_t": np.sqrt(np.mean(np.square(offset_errors))),
        "mae_t": np.mean(offset_errors),
        "recall": np.mean(right),
        "angle": np.mean(turns),
        "distance": np.mean(lengths),
    }


@pytest.mark.parametrize("degrees", [0.1, 4.0, 90.0])
def test_the_figures_are_those_of_scipy(degrees, truth, randn, dtype):
    turns = Rotation.from_rotvec(np.deg2rad(degrees) * randn(30, 3).numpy()).as_matrix()
    estimate = torch.from_numpy(turns) @ truth[0], truth[1] + 0.03 * randn(30, 3)
    estimate, truth = [x.to(dtype) for x in estimate], [x.to(dtype) for x in truth]
    found = measure(*estimate, *truth).to_dict()
    assert found == pytest.approx(measured_by_scipy(estimate, truth), rel=1e-3 if dtype == torch.float32 else 1e-9)


def test_the_truth_has_no_error(truth, dtype):
    truth = [x.to(dtype) for x in truth]
    assert measure(*truth, *truth) == Metrics(rmse_r=0, mae_r=0, rmse_t=0, mae_t=0, recall=1, angle=0, distance=0)


def test_angles_wrap_around():
    zero = torch.zeros(2, 3)
    found = measure(about_z(-179, 178), zero, about_z(179, -178), zero)
    assert found.mae_r == pytest.approx((2 + 4) / 6)
    assert found.rmse_r == pytest.approx(np.sqrt((2**2 + 4**2) / 6))
    assert found.recall == 1


def test_figures_are_over_all_angles_and_all_coordinates():
    found = measure(about_z(3, 6), torch.tensor([[3.0, 0, 0], [0, 0, -6]]), about_z(0, 0), torch.zeros(2, 3))
    assert (found.mae_r, found.mae_t) == pytest.approx((1.5, 1.5))
    assert (found.rmse_r, found.rmse_t) == pytest.approx((np.sqrt(7.5), np.sqrt(7.5)))


@pytest.mark.parametrize(
    ("degrees", "offset", "recall"), [(4.99, 0.0499, 1), (5.01, 0.0499, 0), (4.99, 0.0501, 0), (-4.99, -0.0499, 1)]
)
def test_recall_needs_5_degrees_and_5_hundredths(degrees, offset, recall):
    translation = offset * torch.tensor([[2.0, -1.0, 2.0]]) / 3
    assert measure(about_z(degrees), translation, about_z(0), torch.zeros(1, 3)).recall == recall


def test_recall_takes_the_angle_of_the_rotation_and_not_its_euler_angles():
    three_axes = torch.from_numpy(Rotation.from_euler("ZYX", [[4, 4, 4]], degrees=True).as_matrix())
    zero = torch.zeros(1, 3)
    assert measure(three_axes, zero, about_z(0), zero).recall == 0
    # near gimbal lock a small turn changes two Euler angles a lot
    tilted = torch.from_numpy(Rotation.from_euler("ZYX", [[0, 89.9, 0]], degrees=True).as_matrix())
    small = torch.from_numpy(Rotation.from_rotvec([[0.02, 0, 0.02]]).as_matrix())
    found = measure(small @ tilted, zero, tilted, zero)
    assert found.recall == 1
    assert found.mae_r > 5


def chamfer_slowly(pairs, whole: Tensor, rotation: Tensor, translation: Tensor) -> float:
    """RPM-Net's modified Chamfer distance, point by point."""
    means = []
    for b in range(len(pairs)):
        there = whole[b] @ pairs.rotation[b].T + pairs.translation[b]
        moved = [cloud @ rotation[b].T + translation[b] for cloud in (pairs.source[b], whole[b])]
        to_target = [(there - point).square().sum(-1).min() for point in moved[0]]
        to_source = [(moved[1] - point).square().sum(-1).min() for point in pairs.target[b]]
        means.append(sum(to_target) / len(to_target) + sum(to_source) / len(to_source))
    return float(sum(means) / len(means))


@pytest.mark.parametrize("count", [3, CHUNK + 2])
def test_the_modified_chamfer_distance_is_that_of_its_definition(count, randn, generator):
    whole = randn(count, 24, 3, dtype=torch.float32)
    pairs = fixed_practice_pairs(whole, 0, any_rotation=True)
    estimate = random_rotation(count, generator=generator), randn(count, 3, dtype=torch.float32)
    found = modified_chamfer(pairs, whole, *estimate)
    assert found == pytest.approx(chamfer_slowly(pairs, whole, *estimate), rel=1e-4)


def test_the_modified_chamfer_distance_forgives_a_turn_about_an_axis_of_symmetry():
    ring = Rotation.from_euler("z", np.arange(0, 360, 5)[:, None], degrees=True).apply([1.0, 0, 0])
    whole = torch.from_numpy(np.concatenate([ring, ring * 0.5 + [0, 0, 1]])).float()[None]
    pairs = fixed_practice_pairs(whole, 0, any_rotation=False)
    truth = pairs.rotation, pairs.translation
    turned = pairs.rotation @ about_z(90).float(), pairs.translation
    tilted = pairs.rotation @ torch.from_numpy(Rotation.from_euler("x", [90.0], degrees=True).as_matrix()).float()
    right, same, wrong = (
        modified_chamfer(pairs, whole, *estimate) for estimate in (truth, turned, (tilted, pairs.translation))
    )
    assert same == pytest.approx(right, rel=0.05)
    assert wrong > 100 * right
