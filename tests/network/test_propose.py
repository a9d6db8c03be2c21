"""Candidate transforms from the network, and the rotations it starts from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from idam.network.config import Config
from idam.network.geometry import random_rotation
from idam.network.model import IDAM, KeyPoints, Output
from idam.network.pretrained import load_model
from idam.network.propose import as_transforms, propose, starting_rotations

SHIFT = torch.tensor([0.3, -0.2, 0.1])


def angles(a: Tensor, b: Tensor) -> np.ndarray:
    """Degrees between each of a (A, 3, 3) and each of b (B, 3, 3)."""
    cosine = (torch.einsum("aij,bij->ab", a.double(), b.double()) - 1) / 2
    return np.degrees(np.arccos(cosine.clamp(-1, 1).numpy()))


# --- where to start ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_starting_rotations_begin_with_identity_and_spread(seed: int, assert_rotations) -> None:
    starts = starting_rotations(24, seed)
    assert starts.shape == (24, 3, 3)
    assert_rotations(starts)
    assert (starts[0] == torch.eye(3)).all()
    between = angles(starts, starts)
    # 24 random ones come within 35 degrees of each other
    assert between[~np.eye(24, dtype=bool)].min() > 65
    anywhere = torch.as_tensor(Rotation.random(1000, rng=np.random.default_rng(0)).as_matrix())
    assert angles(anywhere, starts).min(1).max() < 80


def test_starting_rotations_follow_the_seed_alone() -> None:
    starts = starting_rotations(8, 5)
    torch.rand(3)
    state = torch.get_rng_state()
    assert (starting_rotations(8, 5) == starts).all()
    assert (torch.get_rng_state() == state).all()
    assert (starting_rotations(8, 6)[1:] != starts[1:]).any()


def test_one_start_is_the_identity() -> None:
    assert (starting_rotations(1, 3) == torch.eye(3)).all()


# --- what the network proposes -------------------------------------------------------------------------------------


@pytest.fixture
def source(randn) -> np.ndarray:
    return (randn(120, 3) * torch.tensor([0.5, 0.3, 0.2])).numpy()


@pytest.fixture
def target(randn) -> np.ndarray:
    return (randn(90, 3) * torch.tensor([0.4, 0.3, 0.2])).numpy()


@pytest.fixture(params=["shipped", "gnn", "fpfh"])
def network(request: pytest.FixtureRequest) -> IDAM:
    if request.param == "shipped":
        return load_model()
    return IDAM(Config(features=request.param)).eval()


@pytest.fixture
def starts(generator: torch.Generator) -> Tensor:
    return torch.cat([torch.eye(3)[None], random_rotation(3, generator=generator)])


class Shifting(IDAM):
    """A network whose answer is always the same shift of the cloud it sees, and that trusts later starts more."""

    def match(self, source: KeyPoints, target: KeyPoints, *options: Any) -> Output:
        output = super().match(source, target, *options)
        batch = len(source.points)
        return replace(
            output,
            rotation=torch.eye(3).repeat(batch, 1, 1),
            translation=SHIFT.repeat(batch, 1),
            trust=torch.arange(batch) / batch,
        )


class Indifferent(Shifting):
    """One that trusts all alike."""

    def match(self, source: KeyPoints, target: KeyPoints, *options: Any) -> Output:
        output = super().match(source, target, *options)
        return replace(output, trust=torch.full_like(output.trust, 0.5))


@pytest.mark.parametrize("features", ["gnn", "fpfh"])
@pytest.mark.parametrize("kind", [Shifting, Indifferent])
def test_network_sees_the_source_turned_and_what_it_trusts_comes_first(
    kind: type[IDAM], features: str, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    proposed = propose(kind(Config(features=features)).eval(), source, target, starts)
    assert len(proposed) == len(starts)
    expected = starts.double().numpy()
    for transformation, start in zip(proposed, expected[::-1] if kind is Shifting else expected, strict=True):
        np.testing.assert_allclose(transformation[:3, :3], start, atol=1e-6)
        np.testing.assert_allclose(transformation[:3, 3], SHIFT, atol=1e-6)


def test_transforms_are_rigid_in_double_precision(
    network: IDAM, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    for transformation in propose(network, source, target, starts):
        rotation = transformation[:3, :3]
        assert transformation.dtype == np.float64
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_array_equal(transformation[3], [0, 0, 0, 1])


def test_as_transforms_takes_the_rotations_nearest_to_inexact_ones(generator: torch.Generator) -> None:
    rotations = random_rotation(5, generator=generator, dtype=torch.float64)
    inexact = (rotations + 1e-4 * torch.randn(5, 3, 3, generator=generator)).float()
    for rotation, transformation in zip(rotations, as_transforms(inexact, SHIFT.expand(5, 3)), strict=True):
        np.testing.assert_allclose(transformation[:3, :3], rotation, atol=1e-3)
        np.testing.assert_allclose(transformation[:3, :3] @ transformation[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_array_equal(transformation[:3, 3], SHIFT.double())
        np.testing.assert_array_equal(transformation[3], [0, 0, 0, 1])


@pytest.mark.parametrize("trained", [False, True])
def test_a_start_is_a_source_turned_by_hand(
    trained: bool, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    network = load_model("gnn-unseen-shapes") if trained else IDAM().eval()
    proposed = np.array(propose(network, source, target, starts))
    turned = (torch.as_tensor(source, dtype=torch.float32)[None] @ starts.mT).double().numpy()
    for points, start in zip(turned, starts, strict=True):
        by_hand = propose(network, points, target, torch.eye(3)[None])[0]
        by_hand[:3, :3] = by_hand[:3, :3] @ start.double().numpy()
        # the most trusted come first, wherever they started
        assert np.abs(proposed - by_hand).max((1, 2)).min() < 1e-3


def test_proposals_are_the_same_bits_every_time(
    network: IDAM, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    once, again = (propose(network, source, target, starts) for _ in range(2))
    np.testing.assert_array_equal(once, again)
