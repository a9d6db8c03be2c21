"""General pairs: the truth holds, every part of a scan's fate happens, and nothing else decides than the generator."""

import dataclasses

import pytest
import torch

from idam.data import general
from idam.data.general import POINTS, make_general_pairs
from idam.data.pairs import Pairs
from idam.geometry import apply_transform, nearest


@pytest.fixture
def shapes(rand) -> torch.Tensor:
    """Unit spheres of 500 points: their surface is known everywhere."""
    points = torch.randn(24, 500, 3, generator=torch.Generator().manual_seed(1))
    return torch.nn.functional.normalize(points, dim=-1) * 0.9


@pytest.fixture
def spotless(monkeypatch):
    """Neither noise nor outliers nor scenes."""
    for name in ("MAX_NOISE", "MAX_OUTLIERS", "SCENES"):
        monkeypatch.setattr(general, name, 0.0)


def aligned(pairs: Pairs) -> torch.Tensor:
    return apply_transform(pairs.source, pairs.rotation, pairs.translation)


def test_under_the_truth_both_scans_lie_on_one_surface(shapes, spotless, generator):
    pairs = make_general_pairs(shapes, generator)
    moved = aligned(pairs)
    for n in range(len(pairs)):  # the sphere through the target holds the source
        system = torch.cat([2 * pairs.target[n], torch.ones(POINTS, 1)], 1).double()
        solution = torch.linalg.lstsq(system, pairs.target[n].double().square().sum(-1, keepdim=True)).solution
        radius = (moved[n].double() - solution[:3].T).norm(dim=-1)
        assert radius.std() / radius.mean() < 0.02  # triangles cut the sphere a little


def test_scans_share_no_points_and_only_part_of_the_surface(shapes, spotless, generator):
    pairs = make_general_pairs(shapes, generator)
    distance = nearest(aligned(pairs).double(), pairs.target.double())[0].sqrt()
    assert (distance > 1e-5).float().mean() > 0.999
    overlap = (distance < 0.15).float().mean(-1)
    assert overlap.min() < 0.75
    assert overlap.max() > 0.95


def test_scans_are_centred_and_of_unit_size_as_in_use(shapes, generator):
    pairs = make_general_pairs(shapes, generator)
    for cloud in (pairs.source, pairs.target):
        assert cloud.shape == (24, POINTS, 3)
        assert cloud.mean(1).norm(dim=-1).max() < 1e-5
    sizes = torch.stack([cloud.norm(dim=-1).quantile(0.98, dim=-1) for cloud in (pairs.source, pairs.target)])
    torch.testing.assert_close(sizes.amax(0), torch.ones(24))


@pytest.mark.parametrize(
    ("name", "value"), [("MAX_NOISE", 0.0), ("MAX_OUTLIERS", 0.0), ("SCENES", 0.0), ("VIEWS", 0.0), ("LEAST_KEPT", 1.0)]
)
def test_every_part_of_a_scan_s_fate_plays_its_part(name, value, shapes, monkeypatch):
    before = make_general_pairs(shapes, torch.Generator().manual_seed(3))
    monkeypatch.setattr(general, name, value)
    after = make_general_pairs(shapes, torch.Generator().manual_seed(3))
    assert not torch.equal(before.source, after.source)


def test_a_viewpoint_hides_what_lies_behind(shapes, monkeypatch):
    monkeypatch.setattr(general, "VIEWS", 1.0)
    dense = torch.nn.functional.normalize(torch.randn(4, 6000, 3), dim=-1) * 0.9
    seen = general._seen(dense, torch.Generator().manual_seed(0)).bool()
    for points, mask in zip(dense, seen, strict=True):
        assert 0.25 < mask.float().mean() < 0.5  # half a sphere without the rim, where it looks along the surface
        assert points[mask].mean(0).norm() > 0.5


def test_pairs_depend_on_the_generator_alone(shapes):
    torch.manual_seed(1)
    one = make_general_pairs(shapes, torch.Generator().manual_seed(3))
    torch.manual_seed(2)
    same, other = (make_general_pairs(shapes, torch.Generator().manual_seed(seed)) for seed in (3, 4))
    for field in dataclasses.fields(Pairs):
        assert torch.equal(getattr(one, field.name), getattr(same, field.name))
        assert not torch.equal(getattr(one, field.name), getattr(other, field.name))
