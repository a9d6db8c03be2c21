"""What runs in buffers, in evaluation, against the formula and against the plain operations."""

import pytest
import torch
from torch import Tensor

from idam.network.config import Config
from idam.network.features.gnn import GNN, EdgeLayer, neighbour_graph
from idam.network.inference import largest_messages, score_pairs, takes_plain_operations
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.network.similarity import SimilarityConvolution


@pytest.fixture(params=[1, 17, 10**6], ids=lambda size: f"blocks-of-{size}")
def _blocks(request: pytest.FixtureRequest, monkeypatch) -> None:
    """Rows one by one, several with a smaller block at the end, and all at once."""
    monkeypatch.setattr("idam.network.inference.POINTS_IN_CACHE", request.param)
    monkeypatch.setattr("idam.network.inference.PAIRS_IN_CACHE", request.param * 18)


@pytest.fixture
def clouds(randn, dtype) -> tuple[Tensor, ...]:
    """Two pairs of clouds of different sizes with features of 10 channels; some points are in both clouds."""
    source, target, *features = (randn(*shape, dtype=dtype) for shape in [(2, 7, 3), (2, 9, 3), (2, 7, 10), (2, 9, 10)])
    target[:, :3] = source[:, :3]
    return source, target, *features


@pytest.mark.usefixtures("_blocks")
def test_largest_messages_are_their_formula(randn, generator, dtype, close):
    centre, h, weight, bias = (randn(*shape, dtype=dtype) for shape in [(40, 6), (40, 6), (5, 6), (5,)])
    neighbours = torch.randint(0, 40, (4, 40), generator=generator)
    largest = largest_messages(centre, h, neighbours, (weight, bias))
    for i in range(40):
        messages = [weight @ (centre[i] - h[j]).clamp_min(0) + bias for j in neighbours[:, i]]
        close(largest[i], torch.stack(messages).amax(0))


@pytest.mark.usefixtures("_blocks")
def test_scores_are_those_of_equation_2(randn, clouds, dtype, close):
    shapes = [(8, 24), (8, 8), (8, 8), (1, 8)]
    layers = [(randn(*shape, dtype=dtype), randn(shape[0], dtype=dtype)) for shape in shapes]
    maximum, score = score_pairs(layers, *clouds)
    assert (maximum.shape, score.shape) == ((2, 7, 8), (2, 7, 9))
    source, target, of_source, of_target = clouds
    for b in range(2):
        for i in range(7):
            row = []
            for j in range(9):
                offset = source[b, i] - target[b, j]
                distance = offset.norm()
                direction = offset / distance if distance > 0 else offset
                x = torch.cat([of_source[b, i], of_target[b, j], distance.view(1), direction])
                for weight, bias in layers[:-1]:
                    x = (weight @ x + bias).clamp_min(0)
                row.append(x)
                close(
                    score[b, i, j],
                    (layers[-1][0] @ x + layers[-1][1]).squeeze(),
                    atol=1e-4 if dtype == torch.float32 else 1e-10,
                )
            close(maximum[b, i], torch.stack(row).amax(0))


@pytest.mark.usefixtures("_blocks")
def test_the_convolution_is_the_same_with_and_without_gradients(seasoned, clouds, dtype, close):
    module = seasoned(SimilarityConvolution(10, 8), dtype)
    plain = module(*clouds)
    with torch.no_grad():
        for ours, expected in zip(module(*clouds), plain, strict=True):
            close(ours, expected)


@pytest.mark.usefixtures("_blocks")
def test_an_edge_layer_is_the_same_with_and_without_gradients(seasoned, randn, dtype, close):
    layer, points = seasoned(EdgeLayer(3, 16), dtype), randn(2, 30, 3, dtype=dtype)
    graph, u = neighbour_graph(points, 5), points.flatten(0, 1)
    plain = layer(u, graph)
    with torch.no_grad():
        close(layer(u, graph), plain)


@pytest.mark.parametrize("name", ["gnn-unseen-shapes", "gnn-gaussian-noise"])
def test_trained_weights_give_the_same_features_and_scores(name, randn):
    network = load_model(name)
    points = torch.nn.functional.normalize(randn(1, 400, 3, dtype=torch.float32), dim=-1)
    clouds = points[:, :300], points[:, 100:]
    quick = network.encode(*clouds, network.graphs(*clouds))
    keys = [network.eliminate(x, features) for x, features in zip(clouds, quick, strict=True)]
    arguments = (keys[0].points, keys[1].points, keys[0].features, keys[1].features)
    quick_pairs = network.similarity[0](*arguments)
    network.requires_grad_(True)
    for ours, plain in zip(quick, network.encode(*clouds, network.graphs(*clouds)), strict=True):
        assert (ours - plain).abs().max() < 1e-5 * plain.abs().max()
    for ours, plain in zip(quick_pairs, network.similarity[0](*arguments), strict=True):
        assert (ours - plain).abs().max() < 1e-5 * plain.abs().max()


def test_a_whole_network_is_the_same_with_and_without_gradients(seasoned, randn, close):
    network = seasoned(IDAM(Config(neighbours=5, channels=8, keep=1 / 2)))
    clouds = randn(2, 40, 3), randn(2, 50, 3)
    plain = network(*clouds)
    with torch.inference_mode():
        quick = network(*clouds)
    close(quick.rotation, plain.rotation)
    close(quick.translation, plain.translation)
    close(quick.trust, plain.trust.detach())


def test_plain_operations_where_a_gradient_may_be_asked_for(randn):
    module, frozen, x = GNN().eval(), GNN().eval().requires_grad_(False), randn(1, 20, 3)
    assert takes_plain_operations(module, x)
    assert takes_plain_operations(frozen, x.requires_grad_())
    assert not takes_plain_operations(frozen, x.detach())
    with torch.no_grad():
        assert not takes_plain_operations(module, x)
        assert takes_plain_operations(module.train(), x)
        with torch.autocast("cpu", torch.bfloat16):
            assert takes_plain_operations(frozen, x)
