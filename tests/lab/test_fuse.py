"""Fused convolutions: the same scores and gradients, and only where training gains from them."""

from functools import partial

import torch

from idam.lab.training import fuse
from idam.network.config import Config
from idam.network.model import IDAM


def test_only_training_goes_through_the_compiler(monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda plain, **_: lambda *clouds: asked.append(plain) or plain(*clouds))
    network = IDAM(Config(features="fpfh", channels=4, blocks=2))
    fuse.fuse_convolutions(network)
    clouds = torch.rand(1, 5, 3), torch.rand(1, 6, 3), torch.rand(1, 5, 33), torch.rand(1, 6, 33)
    for layer in network.eval().similarity:
        layer(*clouds)
    assert asked == []
    for layer in network.train().similarity:
        layer(*clouds)
    assert len(asked) == 2
    assert asked[0] != asked[1]


def test_traced_convolutions_are_those_of_plain_operations(monkeypatch):
    # all but the C++ compiler, which not every machine has and which takes long
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    plain, fused = (IDAM(Config(features="fpfh", channels=4, blocks=1)).train() for _ in range(2))
    fused.load_state_dict(plain.state_dict())
    fuse.fuse_convolutions(fused)
    clouds = torch.rand(2, 5, 3), torch.rand(2, 6, 3), torch.rand(2, 5, 33), torch.rand(2, 6, 33)
    found = []
    for network in (plain, fused):
        maximum, score = network.similarity[0](*clouds)
        (maximum.sum() + score.square().sum()).backward()
        found.append([maximum, score, *(parameter.grad for parameter in network.similarity.parameters())])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-4)
