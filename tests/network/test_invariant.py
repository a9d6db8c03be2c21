"""Invariant features in torch: one with the NumPy descriptor, their parts against slow versions, their gradients."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from idam.describe.invariant import surroundings
from idam.network.config import Config
from idam.network.features import build_features
from idam.network.features.invariant import LENGTH, Invariant, Message, largest_message
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.weights import list_models, load_descriptor, provenance
from shapes import blob, degenerate_clouds

DESCRIPTORS = [name for name in list_models() if provenance(name)["config"]["features"] == "invariant"]


@pytest.fixture
def cloud() -> np.ndarray:
    """300 points (N, 3) of a bumpy surface without symmetry."""
    return blob(300)


@pytest.fixture
def graph(randn, generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random h (N, C), weight (C, 5), near (K, N), pairs (5, K, N)."""
    near = torch.stack([torch.randperm(12, generator=generator) for _ in range(4)])
    return randn(12, 6, requires_grad=True), randn(6, 5, requires_grad=True), near, randn(5, 4, 12)


@pytest.mark.parametrize("count", [2, 50, 1000])
@pytest.mark.parametrize("name", DESCRIPTORS)
def test_torch_and_numpy_describe_alike(name, count):
    around = surroundings(blob(count))
    in_torch = load_model(name).features.describe(around).numpy()
    np.testing.assert_allclose(load_descriptor(name).describe(around), in_torch, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_none_of_a_shipped_descriptor_s_activations_is_denormal(name, cloud):
    features, found = load_model(name).features, []
    for module in features.modules():
        module.register_forward_hook(lambda _module, _inputs, output: found.append(output))
    features(torch.from_numpy(cloud)[None])
    assert len(found) > 15
    assert not any(((x != 0) & (x.abs() < torch.finfo(torch.float32).tiny)).any() for x in found)


def test_clouds_of_a_batch_do_not_see_each_other(cloud, randn, close):
    clouds, features = torch.stack([torch.from_numpy(cloud), randn(300, 3)]).float(), Invariant()
    close(features(clouds), torch.cat([features(clouds[:1]), features(clouds[1:])]))


def test_points_are_told_apart_by_vectors_of_one_length(cloud, close):
    found = Invariant()(torch.from_numpy(cloud)[None])
    assert found.shape == (1, 300, 32)
    close(found.norm(dim=-1), torch.full((1, 300), LENGTH))
    assert torch.cdist(found[0], found[0]).fill_diagonal_(torch.inf).min() > 1e-4


@pytest.mark.parametrize("name", degenerate_clouds())
def test_degenerate_clouds_have_finite_features_and_gradients(name):
    features = Invariant()
    found = features(torch.from_numpy(degenerate_clouds()[name])[None])
    found.square().sum(-1).sqrt().sum().backward()
    assert found.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in features.parameters())


def test_the_largest_message_is_the_maximum_over_messages(graph, close, randn):
    h, weight, near, pairs = graph
    ours = largest_message(h, weight, near, pairs)
    plain = (F.embedding(near, h) + F.linear(pairs.movedim(0, -1), weight)).amax(0)
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
    messages = F.embedding(near, layer.other(x)) + layer.pair(pairs.movedim(0, -1))
    gathered = layer.update((layer.own(x) + messages.amax(0)).relu())
    close(layer(x, near, pairs), layer.norm(x + gathered).relu())


def test_a_layer_looks_as_far_as_its_neighbours(cloud):
    features, around = Invariant().double(), surroundings(cloud)
    reached = {0}
    for layer in reversed(around.near):
        reached |= set(layer[:, list(reached)].flatten().tolist())
    outside, inside = sorted(set(range(300)) - reached), sorted(reached)
    before = features.describe(around)[0]
    for rows, same in ((outside, True), (inside, False)):
        histograms = around.histograms.copy()
        histograms[rows] = 0
        assert torch.equal(features.describe(around._replace(histograms=histograms))[0], before) == same


def test_every_parameter_gets_a_gradient(cloud):
    features = Invariant()
    features(torch.from_numpy(cloud)[None])[..., :7].sum().backward()
    assert all(parameter.grad.any() for parameter in features.parameters())


def test_the_network_takes_them_by_name(cloud):
    config = Config(features="invariant", convolution=False, hybrid_elimination=False, iterations=1, blocks=1)
    assert isinstance(build_features(config), Invariant)
    network = IDAM(config).eval()
    points = torch.from_numpy(cloud).float()[None]
    assert network(points, points[:, :250]).rotation.isfinite().all()
    assert network.features.rotation_invariant
