"""Poses that a shape's symmetry makes as good as the truth."""

import math

import pytest
import torch
from torch import Tensor

from idam.lab.evaluation.symmetry import right_up_to_symmetry, surface_distance
from idam.network.geometry import apply_transform, compose, euler_xyz_to_rotation, random_rotation

WITHIN = (5.0, 0.05)


def bottle(rand) -> Tensor:
    """A closed cylinder about z, and a thinner one on it (1, 1024, 3)."""
    angle, height = rand(1024) * 2 * math.pi, rand(1024)
    radius = torch.where(height > 0.6, 0.15, 0.4)
    return torch.stack([radius * angle.cos(), radius * angle.sin(), 1.6 * height - 0.8], -1)[None].float()


def plank(rand) -> Tensor:
    """The faces of a box of three different sides: half turns about its axes put it on itself."""
    points = rand(1024, 3) * 2 - 1
    points[torch.arange(1024), torch.arange(1024) % 3] = (rand(1024) > 0.5).double() * 2 - 1
    return (points * torch.tensor([0.8, 0.5, 0.2]))[None].float()


def right(shape: Tensor, degrees: tuple[float, float, float], shift: float = 0.0) -> bool:
    """Whether a pose that far from the truth, in the shape's own frame, counts; the truth is some other pose."""
    truth = random_rotation(1, generator=torch.Generator().manual_seed(3)), torch.tensor([[0.3, -0.2, 0.1]])
    off = euler_xyz_to_rotation(torch.tensor([degrees]).deg2rad()), torch.tensor([[0.0, 0.0, shift]])
    return bool(right_up_to_symmetry(shape, compose(*truth, *off), truth, WITHIN)[0])


@pytest.mark.parametrize("turn", [10, 45, 180])
def test_any_turn_of_a_bottle_about_its_axis_is_right(turn, rand):
    assert right(bottle(rand), (0, 0, turn))


@pytest.mark.parametrize("axis", range(3))
def test_a_plank_s_half_turns_are_right_and_its_quarter_turns_are_not(axis, rand):
    for degrees, expected in ((180, True), (90, False)):
        assert right(plank(rand), tuple(degrees * float(n == axis) for n in range(3))) == expected


@pytest.mark.parametrize("degrees", [(10, 0, 0), (0, 10, 0), (180, 0, 0), (0, 20, 45)])
def test_a_bottle_that_leans_or_stands_on_its_head_is_wrong(degrees, rand):
    assert not right(bottle(rand), degrees)


def test_bounds_are_those_of_the_plain_recall_about_every_such_pose(rand):
    for turn in (0, 180):
        assert right(plank(rand), (0, 0, turn + 4), 0.03)
        assert not right(plank(rand), (0, 0, turn + 7))
        assert not right(plank(rand), (0, 0, turn), 0.09)


def test_every_shape_is_judged_by_itself(rand):
    shapes = torch.cat([bottle(rand), plank(rand)] * 20)
    turn = euler_xyz_to_rotation(torch.tensor([[0, 0, math.pi / 3]])).expand(40, 3, 3)
    truth = torch.eye(3).expand(40, 3, 3), torch.zeros(40, 3)
    assert right_up_to_symmetry(shapes, (turn, truth[1]), truth, WITHIN).tolist() == [True, False] * 20


def test_two_samplings_of_one_surface_have_no_distance(rand):
    shape = plank(rand)
    one, other = shape[:, ::2], shape[:, 1::2]
    assert surface_distance(one, other).abs() < 0.005
    apart = apply_transform(one, torch.eye(3)[None], torch.tensor([[0.0, 0.0, 0.5]]))
    assert surface_distance(apart, other) > 0.1
