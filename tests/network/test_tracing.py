"""With neighbours given, nothing is searched: features and network trace and export, and run on any device."""

import io
import warnings

import pytest
import torch
from torch import Tensor, nn

from idam.network.config import Config
from idam.network.features import GNN
from idam.network.features import gnn as features
from idam.network.features.gnn import neighbours_of
from idam.network.model import IDAM
from idam.network.pretrained import load_model


@pytest.fixture
def clouds(randn) -> tuple[Tensor, Tensor]:
    return randn(1, 60, 3).float(), randn(1, 70, 3).float()


@pytest.fixture
def gnn(seasoned) -> GNN:
    return seasoned(GNN(neighbours=5, layers=2), torch.float32).requires_grad_(False)


class Registration(nn.Module):
    """A network's answer as a tuple, which exporters take."""

    def __init__(self, network: IDAM) -> None:
        super().__init__()
        self.network = network

    def forward(self, source: Tensor, target: Tensor, near: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        output = self.network(source, target, (near, other))
        return output.rotation, output.translation


@pytest.fixture
def no_search(monkeypatch) -> None:
    def search(*_: object) -> None:
        raise AssertionError("neighbours were given, and yet searched for")

    monkeypatch.setattr(features, "nearest_by_tree", search)
    monkeypatch.setattr(features, "nearest_neighbours", search)


@pytest.mark.parametrize("train", [False, True])
def test_given_neighbours_give_the_features_of_those_found(train, gnn, clouds, close):
    gnn.train(train)
    near = gnn.graph(clouds[0])
    assert near.shape == (1, 60, 5)
    close(gnn(clouds[0], near), gnn(clouds[0]))
    close(gnn(clouds[0], near.flip(-1)), gnn(clouds[0]), atol=1e-4)  # in any order


def test_each_cloud_s_neighbours_are_its_own_rows(clouds, randn):
    batch = torch.cat([clouds[0], randn(2, 60, 3).float()])
    found = neighbours_of(batch, 4)
    for cloud, near in zip(batch, found, strict=True):
        assert torch.equal(near, torch.cdist(cloud, cloud).argsort(-1)[:, 1:5])


@pytest.mark.parametrize("sizes", [(60, 60), (60, 70)])
@pytest.mark.parametrize("config", [{}, {"keep_again": (1.0,), "trusted": 1.1}], ids=["one try", "more tries"])
def test_a_network_with_given_neighbours_searches_none(sizes, config, seasoned, randn, no_search):
    network = seasoned(IDAM(Config(neighbours=5, channels=8, keep=1 / 2, **config)), torch.float32)
    source, target = (randn(2, size, 3).float() for size in sizes)
    near = tuple(torch.cdist(x, x).argsort(-1)[..., 1:6] for x in (source, target))
    output = network(source, target, near)
    assert output.rotation.isfinite().all()


def traced(module: nn.Module, inputs: tuple[Tensor, ...]) -> nn.Module:
    """Traced, saved and loaded again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that become constants, and that TorchScript is no longer developed
        file = io.BytesIO()
        torch.jit.save(torch.jit.trace(module, inputs, check_trace=False), file)
        file.seek(0)
        return torch.jit.load(file)


def exported(module: nn.Module, inputs: tuple[Tensor, ...]) -> nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own deprecations
        return torch.export.export(module, inputs).module()


WAYS = pytest.mark.parametrize("leave", [traced, exported])


@WAYS
def test_features_leave_python(leave, gnn, clouds, randn, close, no_search):
    near = torch.cdist(clouds[0], clouds[0]).argsort(-1)[..., 1:6]
    left = leave(gnn, (clouds[0], near))
    close(left(clouds[0], near), gnn(clouds[0], near))
    other = randn(1, 60, 3).float()
    other_near = torch.cdist(other, other).argsort(-1)[..., 1:6]
    close(left(other, other_near), gnn(other, other_near))


@WAYS
def test_the_whole_network_leaves_python_with_one_try(leave, clouds, randn, close):
    network = load_model("gnn-unseen-shapes")
    network.config = Config()
    module = Registration(network.eval().requires_grad_(False))
    points = randn(1, 200, 3).float()
    source, target = points[:, :150], points[:, 50:]
    inputs = (source, target, network.features.graph(source), network.features.graph(target))
    for one, other in zip(leave(module, inputs)(*inputs), module(*inputs), strict=True):
        close(one, other, atol=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device here")
def test_a_gpu_finds_neighbours_itself(gnn, clouds, close, monkeypatch):
    near = gnn.graph(clouds[0])
    monkeypatch.setattr(features, "nearest_by_tree", None)
    assert torch.equal(gnn.cuda().graph(clouds[0].cuda()).cpu().sort(-1).values, near.sort(-1).values)


def test_a_model_can_be_unfrozen_and_then_learns(clouds):
    network = load_model("gnn-unseen-shapes").requires_grad_(True).train()
    network(*clouds).iterations[0].score.square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.features.parameters())
