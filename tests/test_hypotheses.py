"""Candidate transforms from the network, and the rotations it starts from."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from idam.geometry import random_rotation, weighted_procrustes
from idam.hypotheses import propose, starting_rotations
from idam.network.config import Config
from idam.network.model import IDAM, KeyPoints, Output
from idam.network.pretrained import load_model

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
    """A network whose answer is always the same shift of the cloud it sees."""

    def match(self, source: KeyPoints, target: KeyPoints, *options: Any) -> Output:
        output = super().match(source, target, *options)
        batch = len(source.points)
        return replace(output, rotation=torch.eye(3).repeat(batch, 1, 1), translation=SHIFT.repeat(batch, 1))


def farthest(rows: np.ndarray, points: np.ndarray) -> float:
    """How far any of the rows is from all of the points."""
    return float(np.linalg.norm(rows[:, None] - points, axis=-1).min(1).max())


@pytest.mark.parametrize("features", ["gnn", "fpfh"])
def test_network_sees_the_source_turned(features: str, source: np.ndarray, target: np.ndarray, starts: Tensor) -> None:
    proposed = propose(Shifting(Config(features=features)).eval(), source, target, starts)
    assert len(proposed) == len(starts)
    for hypothesis, start in zip(proposed, starts.double().numpy(), strict=True):
        np.testing.assert_allclose(hypothesis.transformation[:3, :3], start, atol=1e-6)
        np.testing.assert_allclose(hypothesis.transformation[:3, 3], SHIFT, atol=1e-6)


def test_transforms_are_rigid_in_double_precision(
    network: IDAM, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    for hypothesis in propose(network, source, target, starts):
        rotation = hypothesis.transformation[:3, :3]
        assert hypothesis.transformation.dtype == np.float64
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_array_equal(hypothesis.transformation[3], [0, 0, 0, 1])


def test_matches_are_in_the_coordinates_given(
    network: IDAM, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    for hypothesis in propose(network, source, target, starts):
        matches = hypothesis.matches
        kept = math.ceil(network.config.keep * len(source))
        assert matches.source.shape == matches.target.shape == (kept, 3)
        assert farthest(matches.source, source) < 1e-6
        assert matches.weight.shape == (kept,)
        assert matches.weight.sum() == pytest.approx(1.0)
        assert matches.weight.min() >= 0


@pytest.mark.parametrize("features", ["gnn", "fpfh"])
def test_hard_matches_are_points_of_the_target(
    features: str, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    network = IDAM(Config(features=features)).eval()
    assert max(farthest(h.matches.target, target) for h in propose(network, source, target, starts)) < 1e-6


def test_transform_is_what_the_matches_say(
    network: IDAM, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    for hypothesis in propose(network, source, target, starts):
        matches = hypothesis.matches
        best = weighted_procrustes(*map(torch.as_tensor, (matches.source, matches.target, matches.weight)))
        found = hypothesis.transformation[:3, :3], hypothesis.transformation[:3, 3]
        # untrained, all may match one point: then many transforms are as good
        left, least = (
            (matches.weight * ((matches.source @ np.asarray(r).T + np.asarray(t) - matches.target) ** 2).sum(1)).sum()
            for r, t in (found, best)
        )
        assert left == pytest.approx(least, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("trained", [False, True])
def test_a_start_is_a_source_turned_by_hand(
    trained: bool, source: np.ndarray, target: np.ndarray, starts: Tensor
) -> None:
    network = load_model("gnn-unseen-shapes") if trained else IDAM().eval()
    turned = (torch.as_tensor(source, dtype=torch.float32)[None] @ starts.mT).double().numpy()
    for hypothesis, points, start in zip(propose(network, source, target, starts), turned, starts, strict=True):
        by_hand = propose(network, points, target, torch.eye(3)[None])[0]
        together = by_hand.transformation[:3, :3] @ start.double().numpy()
        np.testing.assert_allclose(hypothesis.transformation[:3, :3], together, atol=1e-3)
        np.testing.assert_allclose(hypothesis.transformation[:3, 3], by_hand.transformation[:3, 3], atol=1e-3)
        np.testing.assert_allclose(hypothesis.matches.target, by_hand.matches.target, atol=1e-6)
