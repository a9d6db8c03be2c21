"""The practice protocol: disjoint halves, independent crops, and a truth that holds."""

import dataclasses
import math

import pytest
import torch

from idam.lab.data.pairs import MAX_ANGLE, NOISE, NOISE_CLIP, Pairs
from idam.lab.data.practice import KEPT, fixed_practice_pairs, make_practice_pairs
from idam.network.geometry import (
    apply_transform,
    euler_xyz_to_rotation,
    invert,
    nearest,
    rotation_angle,
    square_distance,
)

BOTH = pytest.mark.parametrize("any_rotation", [False, True])


@pytest.fixture
def shapes(randn) -> torch.Tensor:
    """Far apart points, so that noise leaves no doubt which is which."""
    return randn(8, 100, 3, dtype=torch.float32) * 100


def origins(pairs: Pairs, shapes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Which point of its shape each point was."""
    back = apply_transform(pairs.target, *invert(pairs.rotation, pairs.translation))
    distances = [square_distance(cloud.double(), shapes.double()) for cloud in (pairs.source, back)]
    assert all(d.min(-1).values.max() <= 3 * (NOISE_CLIP + 1e-3) ** 2 for d in distances)
    return distances[0].argmin(-1), distances[1].argmin(-1)


@BOTH
def test_the_clouds_share_no_point_and_have_seven_tenths_of_a_half_each(any_rotation, shapes):
    pairs = fixed_practice_pairs(shapes, 0, any_rotation=any_rotation)
    assert pairs.source.shape == pairs.target.shape == (8, 35, 3)
    assert KEPT * 50 == 35
    for source, target in zip(*origins(pairs, shapes), strict=True):
        assert len({*source.tolist(), *target.tolist()}) == 70


@BOTH
def test_each_cloud_is_cut_by_a_plane_of_its_own(any_rotation, shapes):
    # of 50 points the 35 lowest along a direction: their mean lies off the shape's, and not on the same side
    pairs = fixed_practice_pairs(shapes.repeat(40, 1, 1), 0, any_rotation=any_rotation)
    kept = [torch.stack([shapes.repeat(40, 1, 1)[b][i] for b, i in enumerate(index)]).mean(1)
            for index in origins(pairs, shapes.repeat(40, 1, 1))]  # fmt: skip
    assert kept[0].norm(dim=-1).mean() > 30
    assert torch.nn.functional.cosine_similarity(*kept).abs().mean() < 0.8


def test_rotations_are_the_paper_s_or_any(shapes, generator):
    many = shapes.repeat(50, 1, 1)
    small = make_practice_pairs(many, generator).rotation
    assert torch.rad2deg(torch.tensor(MAX_ANGLE)) == 45
    assert rotation_angle(small).max() <= rotation_angle(euler_xyz_to_rotation(torch.full((3,), MAX_ANGLE))) + 1e-3
    angles = rotation_angle(make_practice_pairs(many, generator, math.pi).rotation)
    assert angles.max() > 170
    assert (angles > 90).float().mean() == pytest.approx(0.82, abs=0.07)  # 1/2 + 1/pi of SO(3)
    assert rotation_angle(make_practice_pairs(many, generator, 0.5).rotation).max() <= math.degrees(0.5) + 1e-3


@pytest.mark.parametrize("max_angle", [None, 1.0])
def test_pairs_to_train_on_are_of_one_surface(max_angle, generator):
    line = torch.linspace(-1, 1, 400).unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0])
    pairs = make_practice_pairs(line.repeat(4, 1, 1), generator, max_angle)
    moved = apply_transform(pairs.source, pairs.rotation, pairs.translation)
    assert nearest(moved, pairs.target)[0].sqrt().quantile(0.3) < 3 * NOISE


@BOTH
def test_a_test_pair_depends_on_its_seed_and_index_alone(any_rotation, shapes):
    torch.manual_seed(5)
    pairs = fixed_practice_pairs(shapes, 3, any_rotation=any_rotation)
    first = fixed_practice_pairs(shapes[:2], 3, any_rotation=any_rotation)
    other = fixed_practice_pairs(shapes, 4, any_rotation=any_rotation)
    for field in dataclasses.fields(Pairs):
        whole = getattr(pairs, field.name)
        torch.testing.assert_close(getattr(first, field.name), whole[:2])
        assert not torch.equal(getattr(other, field.name), whole)


def test_both_tables_differ_in_the_rotation_alone(shapes):
    small, any_ = (fixed_practice_pairs(shapes, 3, any_rotation=turn) for turn in (False, True))
    assert torch.equal(small.source, any_.source)
    assert torch.equal(small.translation, any_.translation)
    assert not torch.equal(small.rotation, any_.rotation)
