"""The partial-overlap protocol: what is drawn, what is kept, and what a pair depends on."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from idam.lab.data.pairs import EXPERIMENTS, Pairs, _nearest_to, experiment_noise, fixed_pairs, make_pairs
from idam.network.geometry import apply_transform

SHAPES, POINTS, KEPT = 8, 1024, 768


@pytest.fixture
def shapes(randn) -> Tensor:
    """Random points on unit spheres."""
    return torch.nn.functional.normalize(randn(SHAPES, POINTS, 3, dtype=torch.float32), dim=-1)


@pytest.fixture
def grid() -> Tensor:
    """One shape whose points are so far apart that noise does not change which one is nearest."""
    return torch.cartesian_prod(torch.arange(16.0), torch.arange(8.0), torch.arange(8.0))[None]


def aligned(pairs: Pairs) -> Tensor:
    return apply_transform(pairs.source, pairs.rotation, pairs.translation)


def row_of_nearest(points: Tensor, among: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Distance to, and row of, the nearest of a cloud's points."""
    return cKDTree(among.double().numpy()).query(points.double().numpy())


def same(one: Pairs, other: Pairs) -> bool:
    return all(torch.equal(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(Pairs))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_both_clouds_have_768_points_in_single_precision(noise, shapes, generator):
    pairs = make_pairs(shapes, generator, noise)
    assert len(pairs) == SHAPES
    assert pairs.source.shape == pairs.target.shape == (SHAPES, KEPT, 3)
    assert pairs.rotation.shape == (SHAPES, 3, 3)
    assert pairs.translation.shape == (SHAPES, 3)
    assert pairs.source.dtype == pairs.target.dtype == pairs.rotation.dtype == torch.float32


def test_angles_and_translations_are_uniform_in_their_ranges(generator):
    pairs = make_pairs(torch.rand(3000, 4, 3, generator=generator), generator)
    angles = Rotation.from_matrix(pairs.rotation.numpy()).as_euler("XYZ", degrees=True)  # R = Rx Ry Rz
    for drawn, low, high in ((angles, 0, 45), (pairs.translation.numpy(), -0.5, 0.5)):
        share = (drawn - low) / (high - low)
        assert share.min() > -1e-5
        assert share.max() < 1 + 1e-5
        assert np.abs(share.mean(0) - 1 / 2).max() < 5 / np.sqrt(12 * 3000)
        assert np.abs(share.var(0) - 1 / 12).max() < 0.01
        correlation = np.corrcoef(share.T) - np.eye(3)
        assert np.abs(correlation).max() < 0.1


def test_without_noise_source_and_target_are_parts_of_one_shape(shapes, generator):
    pairs = make_pairs(shapes, generator)
    for b in range(SHAPES):
        whole = apply_transform(shapes[b], pairs.rotation[b], pairs.translation[b])
        for cloud in (aligned(pairs)[b], pairs.target[b]):
            distance, rows = row_of_nearest(cloud, whole)
            assert distance.max() < 1e-5
            assert len(set(rows)) == KEPT
        assert row_of_nearest(pairs.source[b], shapes[b])[0].max() == 0


def test_without_noise_the_overlap_lies_on_the_target(shapes, generator):
    pairs = make_pairs(shapes, generator)
    for source, target in zip(aligned(pairs), pairs.target, strict=True):
        distance, _ = row_of_nearest(source, target)
        overlap = (distance < 1e-5).sum()
        assert 2 * KEPT - POINTS <= overlap < KEPT


def test_each_crop_keeps_the_768_points_nearest_to_one_far_corner(shapes, generator):
    pairs = make_pairs(shapes, generator)
    corners = [500 * torch.tensor(signs).double() for signs in itertools.product((-1.0, 1.0), repeat=3)]
    found = []
    for b in range(SHAPES):
        whole = apply_transform(shapes[b], pairs.rotation[b], pairs.translation[b])

        def keeps_the_nearest(corner: Tensor, kept: Tensor, all_points: Tensor) -> bool:
            dropped = np.setdiff1d(np.arange(POINTS), row_of_nearest(kept, all_points)[1])
            distance = (all_points.double() - corner).norm(dim=-1)
            # the far point is up to 1 off the corner on every axis, which tilts the cut by 2 parts in 1000
            return bool((kept.double() - corner).norm(dim=-1).max() < distance[dropped].min() + 0.01)

        fitting = [
            n
            for n, corner in enumerate(corners)
            if keeps_the_nearest(corner, pairs.source[b], shapes[b])
            and keeps_the_nearest(corner, pairs.target[b], whole)
        ]
        assert len(fitting) == 1
        found += fitting
    assert len(set(found)) > 1


def test_the_crop_is_exact_in_single_precision(shapes, generator):
    far = 500 * torch.tensor([1.0, -1, 1]) + torch.rand(SHAPES, 3, generator=generator)
    shapes = shapes / 100  # so small that single precision cannot tell their points by the distance to the far point
    kept = _nearest_to(shapes, far)
    for cloud, part, point in zip(shapes.double(), kept, far.double(), strict=True):
        distance = (cloud - point).norm(dim=-1)
        expected = set(distance.argsort()[:KEPT].tolist())
        rows = set(row_of_nearest(part, cloud)[1].tolist())
        for row in rows ^ expected:  # only points as far as the last one kept, but for rounding
            assert abs(distance[row] - distance.sort().values[KEPT - 1]) < 1e-7


def test_small_shapes_are_kept_whole(shapes, generator):
    pairs = make_pairs(shapes[:, :100], generator)
    assert pairs.source.shape == pairs.target.shape == (SHAPES, 100, 3)
    for source, target in zip(aligned(pairs), pairs.target, strict=True):
        assert row_of_nearest(source, target)[0].max() < 1e-5


def test_rows_of_source_and_target_do_not_correspond(shapes, generator):
    pairs = make_pairs(shapes, generator)
    apart = (aligned(pairs) - pairs.target).norm(dim=-1)
    assert (apart < 1e-5).float().mean() < 0.02


@pytest.mark.parametrize("name", ["source", "target"])
def test_the_points_are_in_random_order(name, shapes, generator):
    """A cloud sorted by some direction would show it: its first half would lie elsewhere than its second."""
    for cloud in getattr(make_pairs(shapes, generator), name):
        first, second = cloud[: KEPT // 2].mean(0), cloud[KEPT // 2 :].mean(0)
        assert (first - second).norm() < 0.25


def test_noise_is_gaussian_clipped_and_different_for_source_and_target(grid, generator):
    pairs = make_pairs(grid, generator, noise=0.02)
    inverse = pairs.rotation.mT
    back = apply_transform(pairs.target, inverse, -(inverse @ pairs.translation[..., None])[..., 0])
    source_noise, turned_noise = (
        cloud - grid[0][row_of_nearest(cloud, grid[0])[1]] for cloud in (pairs.source[0], back[0])
    )
    target_noise = turned_noise @ pairs.rotation[0].T
    for drawn in (source_noise, target_noise):
        assert drawn.abs().max() == pytest.approx(0.05, abs=1e-5)
        assert abs(drawn.mean()) < 5 * 0.02 / np.sqrt(3 * KEPT)
        assert drawn.std() == pytest.approx(0.02, rel=0.06)
    for other in (turned_noise, target_noise):
        assert torch.cdist(source_noise, other).min(-1).values.median() > 1e-3


def test_only_one_experiment_has_noise():
    assert {name: experiment_noise(name) for name in EXPERIMENTS} == {
        "unseen-shapes": 0.0,
        "unseen-categories": 0.0,
        "gaussian-noise": 0.01,
    }


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_fixed_pair_depends_on_the_seed_and_its_index_alone(noise, shapes):
    pairs = fixed_pairs(shapes, 3, noise)
    torch.rand(5)  # the global generator has no say
    assert same(fixed_pairs(shapes, 3, noise), pairs)
    assert same(fixed_pairs(shapes[:3], 3, noise), pairs[:3])
    others = shapes.clone()
    others[0] *= 0.5
    assert same(fixed_pairs(others, 3, noise)[1:], pairs[1:])


def test_other_seeds_and_other_indices_give_other_pairs(shapes):
    one, other = fixed_pairs(shapes[:1].expand(4, -1, -1), 3), fixed_pairs(shapes[:1].expand(4, -1, -1), 4)
    angles = torch.cat([one.rotation, other.rotation])
    for i, j in itertools.combinations(range(8), 2):
        assert not torch.allclose(angles[i], angles[j], atol=1e-4)


def test_fixed_pairs_follow_the_protocol(shapes):
    pairs = fixed_pairs(shapes, 3)
    angles = Rotation.from_matrix(pairs.rotation.numpy()).as_euler("XYZ", degrees=True)
    assert angles.min() > -1e-3
    assert angles.max() < 45.001
    for source, target in zip(aligned(pairs), pairs.target, strict=True):
        assert (row_of_nearest(source, target)[0] < 1e-5).sum() >= 2 * KEPT - POINTS


def test_made_pairs_follow_their_generator(shapes):
    one, again, other = (make_pairs(shapes, torch.Generator().manual_seed(seed), 0.01) for seed in (1, 1, 2))
    assert same(one, again)
    assert not torch.equal(one.rotation, other.rotation)


def test_pairs_can_be_sliced_picked_and_moved(shapes, generator):
    pairs = make_pairs(shapes, generator)
    assert same(pairs[torch.tensor([1, 2])], pairs[1:3])
    assert len(pairs[1:3]) == 2
    assert same(pairs.to("cpu"), pairs)
