"""Invariant features: the same in every pose, order and scale; their parts against slow versions; degenerate clouds."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from idam.lab.data.surfaces import random_blob
from idam.network.config import Config
from idam.network.features import build_features
from idam.network.features.fpfh import FPFH
from idam.network.features.invariant import (
    LENGTH,
    NEIGHBOURS,
    STRIDES,
    Invariant,
    Message,
    largest_message,
    pair_features,
    surroundings,
)
from idam.network.features.normals import nearest_neighbours_of
from idam.network.geometry import apply_transform, random_rotation
from idam.network.model import IDAM


@pytest.fixture
def cloud() -> Tensor:
    """300 points (N, 3) of a bumpy surface without symmetry."""
    return torch.from_numpy(random_blob(300, np.random.default_rng(0)) * (1.0, 0.8, 0.5))


@pytest.fixture
def graph(randn, generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random h (N, C), weight (C, 5), near (K, N), pairs (K, N, 5)."""
    near = torch.stack([torch.randperm(12, generator=generator) for _ in range(4)])
    return randn(12, 6, requires_grad=True), randn(6, 5, requires_grad=True), near, randn(4, 12, 5)


def spacing(cloud: Tensor) -> float:
    """The median distance to the nearest other."""
    return float(torch.cdist(cloud, cloud).fill_diagonal_(torch.inf).amin(1).median())


# invariance


def test_pose_and_scale_do_not_matter(cloud, generator, randn, close):
    features, rotation = Invariant().double(), random_rotation(1, generator=generator, dtype=torch.float64)
    moved = 37 * apply_transform(cloud[None], rotation, randn(1, 3))[0]
    close(features.describe(surroundings(moved)), features.describe(surroundings(cloud)), atol=1e-6)


def test_nor_do_they_in_single_precision(cloud, generator, randn):
    features, rotation = Invariant(), random_rotation(1, generator=generator, dtype=torch.float64)
    moved = 37 * apply_transform(cloud[None], rotation, randn(1, 3))
    changed = (features(moved.float()) - features(cloud[None].float())).norm(dim=-1) > 1e-2 * LENGTH
    assert changed.float().mean() < 0.05  # a few histograms have a point on the edge of a bin


def test_permuted_points_give_permuted_features(cloud, generator, close):
    features, order = Invariant().double(), torch.randperm(300, generator=generator)
    close(features.describe(surroundings(cloud[order])), features.describe(surroundings(cloud))[order])


def test_a_mirror_image_has_other_features(cloud):
    features = Invariant().double()
    mirrored = features.describe(surroundings(cloud * torch.tensor([-1, 1, 1])))
    assert (mirrored - features.describe(surroundings(cloud))).norm(dim=-1).median() > 0.01 * LENGTH


def test_clouds_of_a_batch_do_not_see_each_other(cloud, randn, close):
    clouds, features = torch.stack([cloud, randn(300, 3)]).float(), Invariant()
    close(features(clouds), torch.cat([features(clouds[:1]), features(clouds[1:])]))


def test_points_are_told_apart_by_vectors_of_one_length(cloud, close):
    found = Invariant()(cloud[None].float())
    assert found.shape == (1, 300, 32)
    close(found.norm(dim=-1), torch.full((1, 300), LENGTH))
    assert torch.cdist(found[0], found[0]).fill_diagonal_(torch.inf).min() > 1e-4


# surroundings


@pytest.mark.parametrize("of_its_own", [True, False])
def test_histograms_and_neighbours_are_those_of_fpfh(of_its_own, cloud, close):
    unit = spacing(cloud) if of_its_own else 0.2
    around = surroundings(cloud, None if of_its_own else unit)
    fpfh = FPFH(normal_radius=2.5 * unit, feature_radius=6 * unit)
    close(around.histograms, fpfh(cloud[None])[0], atol=1e-6)
    centred = cloud - cloud.mean(0)
    close(around.points, centred / unit)


def test_normals_are_outward_and_of_length_one(cloud, close):
    around = surroundings(cloud)
    close(around.normals.norm(dim=-1), torch.ones(300).double())
    assert ((around.normals * around.points).sum(-1) > 0).double().mean() > 0.95


def test_each_layer_s_neighbours_are_every_so_many_th_of_the_nearest(cloud):
    near = surroundings(cloud).near
    order = torch.cdist(cloud, cloud).fill_diagonal_(torch.inf).argsort(1)
    assert near.shape == (len(STRIDES), NEIGHBOURS, 300)
    for rows, stride in zip(near, (1, 3, 8), strict=True):
        for k in range(16):
            assert torch.equal(rows[k], order[:, stride * (k + 1) - 1])


@pytest.mark.parametrize("count", [2, 3, 20, 100, 128, 129])
def test_small_clouds_have_the_neighbours_there_are(count, cloud):
    around = surroundings(cloud[:count].float())
    assert around.near.shape == (len(STRIDES), NEIGHBOURS, count)
    assert (around.near != torch.arange(count)).all()
    assert (around.near[0] >= 0).all()
    assert (around.near < count).all()
    assert torch.equal(around.near[-1, -1], torch.cdist(cloud[:count], cloud[:count]).argmax(1))
    assert Invariant()(cloud[None, :count].float()).isfinite().all()


def coincident(cloud: Tensor) -> dict[str, Tensor]:
    return {
        "one place": cloud[:1].expand(40, 3),
        "each point twice": cloud[:100].repeat(2, 1),
        "a few points twice": torch.cat([cloud, cloud[:10]]),
        "two places": cloud[:2].repeat(100, 1),
        "a line": cloud[:, :1] * torch.tensor([1.0, 2.0, 3.0]),
        "a plane": cloud * torch.tensor([1.0, 1.0, 0.0]),
    }


@pytest.mark.parametrize("name", coincident(torch.zeros(1, 3)))
def test_degenerate_clouds_have_finite_features_and_gradients(name, cloud):
    features = Invariant()
    found = features(coincident(cloud)[name][None].float())
    found.square().sum(-1).sqrt().sum().backward()
    assert found.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in features.parameters())


def test_copies_of_points_do_not_make_the_spacing(cloud):
    before, after = surroundings(cloud), surroundings(torch.cat([cloud, cloud[:40]]))
    assert after.points[:300].std().item() == pytest.approx(before.points.std().item(), rel=0.05)


# the layers


def direct_pair_features(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """(|d| / 8, n_i . d, n_j . d, n_i . n_j, det(d, n_i, n_j)), a pair at a time."""
    rows = []
    for neighbours in near.tolist():
        for i, j in enumerate(neighbours):
            offset, n, m = points[j] - points[i], normals[i], normals[j]
            distance = offset.norm()
            d = offset / distance if distance > 0 else offset
            rows.append(torch.stack([distance / 8, n @ d, m @ d, n @ m, torch.linalg.det(torch.stack([d, n, m]))]))
    return torch.stack(rows).view(*near.shape, 5)


def test_pair_features_are_their_formula(randn, generator, close, dtype):
    points, normals = randn(10, 3), F.normalize(randn(10, 3), dim=-1)
    points[3] = points[4]
    near = torch.stack([torch.randperm(10, generator=generator) for _ in range(6)])
    near[0, 3] = 4
    found = pair_features(points.to(dtype), normals.to(dtype), near)
    close(found, direct_pair_features(points, normals, near).to(dtype))


def test_the_largest_message_is_the_maximum_over_messages(graph, close, randn):
    h, weight, near, pairs = graph
    ours = largest_message(h, weight, near, pairs)
    plain = (F.embedding(near, h) + F.linear(pairs, weight)).amax(0)
    close(ours, plain)
    direction = randn(12, 6)
    for one, other in zip(*(torch.autograd.grad(x, (h, weight), direction) for x in (ours, plain)), strict=True):
        close(one, other)


def test_the_largest_message_passes_gradcheck(graph):
    h, weight, near, pairs = graph
    assert torch.autograd.gradcheck(lambda h, weight: largest_message(h, weight, near, pairs), (h, weight))


def test_a_layer_is_its_formula(graph, randn, close):
    x, _, near, pairs = graph
    layer = Message(6).double()
    messages = F.embedding(near, layer.other(x)) + layer.pair(pairs)
    gathered = layer.update((layer.own(x) + messages.amax(0)).relu())
    close(layer(x, near, pairs), layer.norm(x + gathered).relu())


def test_a_layer_looks_as_far_as_its_neighbours(cloud):
    features, around = Invariant().double(), surroundings(cloud)
    around.histograms.requires_grad_()
    (gradient,) = torch.autograd.grad(features.describe(around)[0].sum(), around.histograms)
    reached = {0}
    for layer in reversed(around.near):
        reached |= set(layer[:, list(reached)].flatten().tolist())
    assert set(gradient.any(1).nonzero().flatten().tolist()) <= reached
    assert gradient[0].any()
    assert gradient.any(1).sum() > 50


def test_every_parameter_gets_a_gradient(cloud):
    features = Invariant()
    features(cloud[None].float())[..., :7].sum().backward()
    assert all(parameter.grad.any() for parameter in features.parameters())


# in the network


def test_the_network_takes_them_by_name(cloud):
    config = Config(features="invariant", convolution=False, hybrid_elimination=False, iterations=1, blocks=1)
    assert isinstance(build_features(config), Invariant)
    network = IDAM(config).eval()
    output = network(cloud[None].float(), cloud[None, :250].float())
    assert output.rotation.isfinite().all()
    assert network.features.rotation_invariant


def test_nearest_neighbours_are_those_of_all_distances_and_never_the_point_itself():
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points[20:30] = points[20]  # copies, more than are asked for
    distance, near = nearest_neighbours_of(points, 6)
    assert near.shape == (60, 6)
    assert (near != torch.arange(60)[:, None]).all()
    everything = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(torch.inf)
    torch.testing.assert_close(distance, everything.sort(1).values[:, :6])
    torch.testing.assert_close(everything.gather(1, near), distance)
    assert (distance[20:30] == 0).all()


def test_a_cloud_smaller_than_asked_for_has_all_others_as_neighbours():
    distance, near = nearest_neighbours_of(torch.rand(5, 3, generator=torch.Generator().manual_seed(1)), 16)
    assert near.shape == distance.shape == (5, 4)
    assert distance.dtype == torch.float32
    assert [sorted(row) for row in near.tolist()] == [[j for j in range(5) if j != i] for i in range(5)]
