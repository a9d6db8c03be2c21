"""Balanced sampling: half of the points with a match, half without."""

import pytest
import torch
from torch import Tensor

from idam.network.sampling import balanced_sample

RADIUS = 0.05


@pytest.fixture
def scene(randn, generator):
    """Makes source points of which the first few have a target point within r, and the others none."""

    def make(positives: int, negatives: int, batch: int = 3) -> tuple[Tensor, Tensor]:
        grid = torch.cartesian_prod(*[torch.arange(5.0)] * 3)  # points 1 apart, so that none is near another's match
        cloud = torch.stack([grid[torch.randperm(125, generator=generator)] for _ in range(batch)]).double()
        target, aligned = cloud[:, : positives + 10].clone(), cloud.clone()
        aligned[:, :positives] += 0.01 * randn(batch, positives, 3).clamp(-2, 2)
        source = torch.cat([aligned[:, :positives], aligned[:, 115 : 115 + negatives]], 1)
        return source, target[:, torch.randperm(positives + 10, generator=generator)]

    return make


def nearest_distance(source: Tensor, target: Tensor) -> Tensor:
    return torch.cdist(source, target).min(-1).values


@pytest.mark.parametrize(("count", "positives"), [(10, 5), (11, 6), (1, 1), (2, 1)])
def test_half_of_the_points_have_a_match_rounded_up(count, positives, scene, generator):
    source, target = scene(40, 10)
    chosen, _ = balanced_sample(source, target, count, RADIUS, generator)
    assert chosen.shape == (3, count)
    assert (chosen[:, :positives] < 40).all()
    assert (chosen[:, positives:] >= 40).all()


def test_no_point_is_drawn_twice(scene, generator):
    source, target = scene(40, 10)
    chosen, _ = balanced_sample(source, target, 20, RADIUS, generator)
    assert all(len(set(row)) == 20 for row in chosen.tolist())


def test_the_targets_are_the_nearest_of_each_source(randn, generator):
    source, target = randn(3, 40, 3), randn(3, 30, 3)
    chosen, matched = balanced_sample(source, target, 10, RADIUS, generator)
    for b in range(3):
        for i, j in zip(chosen[b], matched[b], strict=True):
            assert j == (source[b, i] - target[b]).norm(dim=-1).argmin()


def test_the_radius_decides_what_has_a_match(scene, generator):
    source, target = scene(40, 10)
    distance = nearest_distance(source, target)
    radius = float(distance[:, :40].quantile(0.5))
    chosen, _ = balanced_sample(source, target, 10, radius, generator)
    sampled = distance.gather(1, chosen)
    assert (sampled[:, :5] <= radius).all()
    assert (sampled[:, 5:] > radius).all()


@pytest.mark.parametrize(("positives", "negatives"), [(0, 10), (40, 0)], ids=["no positives", "no negatives"])
def test_where_one_kind_is_missing_the_other_stands_in(positives, negatives, scene, generator):
    source, target = scene(positives, negatives)
    chosen, matched = balanced_sample(source, target, 8, RADIUS, generator)
    assert chosen.shape == matched.shape == (3, 8)
    for row in chosen.tolist():
        assert len(set(row[:4])) == len(set(row[4:])) == 4


def test_few_positives_are_all_taken_and_the_half_filled_up(scene, generator):
    source, target = scene(3, 10, batch=50)
    chosen, _ = balanced_sample(source, target, 12, RADIUS, generator)
    first_half = chosen[:, :6]
    assert ((first_half < 3).sum(-1) == 3).all()
    assert (chosen[:, 6:] >= 3).all()
    assert all(len(set(row)) == 6 for row in first_half.tolist())


@pytest.mark.parametrize(
    ("positives", "negatives", "first_half", "second_half"),
    [
        (4, 5, [1 / 4] * 4 + [0] * 5, [0] * 4 + [1 / 5] * 5),
        (0, 5, [1 / 5] * 5, [1 / 5] * 5),
        (4, 0, [1 / 4] * 4, [1 / 4] * 4),
    ],
    ids=["both kinds", "no positives", "no negatives"],
)
def test_points_of_a_kind_are_equally_likely(positives, negatives, first_half, second_half, scene, generator):
    source, target = (x.expand(5000, -1, -1) for x in scene(positives, negatives, batch=1))
    chosen, _ = balanced_sample(source, target, 2, RADIUS, generator)
    for drawn, probability in zip(chosen.T, (first_half, second_half), strict=True):
        frequency = drawn.bincount(minlength=positives + negatives) / 5000
        assert (frequency - torch.tensor(probability)).abs().max() < 5 * (0.25 * 0.75 / 5000) ** 0.5


def test_the_draw_follows_its_generator(scene):
    source, target = scene(40, 10)
    one, same, other = (
        balanced_sample(source, target, 10, RADIUS, torch.Generator().manual_seed(seed))[0] for seed in (1, 1, 2)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
