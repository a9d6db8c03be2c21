"""The GNN against its formula with every edge built; its own backward passes; its invariances."""

import pytest
import torch
from torch import Tensor

from idam.network.features.gnn import GNN, EdgeLayer, neighbour_difference, neighbour_graph, neighbour_maximum
from idam.network.geometry import nearest_neighbours

MODES = pytest.mark.parametrize("train", [False, True], ids=["eval", "train"])


@pytest.fixture
def points(randn) -> Tensor:
    """Two clouds, each with a far point that is nobody's neighbour."""
    points = randn(2, 30, 3)
    points[:, 0] += 20
    return points


@pytest.fixture
def direct_gnn(linear_norm_relu):
    """u_i <- f(max_j g(u_i - u_j)), the neighbours by brute force."""

    def neighbours(cloud: Tensor, k: int) -> list[list[int]]:
        distance = torch.cdist(cloud, cloud).fill_diagonal_(torch.inf)
        return [row.argsort()[:k].tolist() for row in distance]

    def run(gnn: GNN, points: Tensor) -> Tensor:
        graph = [neighbours(cloud, gnn.neighbours) for cloud in points.double()]
        u = points
        for layer in gnn.layers:
            edges = torch.stack(
                [
                    torch.stack([torch.stack([cloud[i] - cloud[j] for j in row]) for i, row in enumerate(rows)])
                    for cloud, rows in zip(u, graph, strict=True)
                ]
            )
            messages = linear_norm_relu(layer.second, linear_norm_relu(layer.first, edges))
            u = linear_norm_relu(layer.update, messages.amax(2))
        return u

    return run


@MODES
def test_the_gnn_is_its_formula(train, seasoned, points, direct_gnn, dtype, close):
    gnn, points = seasoned(GNN(neighbours=5), dtype, train=train), points.to(dtype)
    features = gnn(points)
    assert features.shape == (2, 30, 64)
    close(features, direct_gnn(gnn, points), atol=3e-4 if dtype == torch.float32 else 1e-10)


@MODES
def test_its_gradient_is_that_of_its_formula(train, seasoned, points, direct_gnn, same_gradients):
    gnn = seasoned(GNN(neighbours=5, layers=3), train=train)
    same_gradients(gnn, gnn(points), direct_gnn(gnn, points))


def test_the_paper_s_gnn_has_five_layers_of_64_and_12_neighbours():
    gnn = GNN()
    assert gnn.neighbours == 12
    shapes = [[tuple(p.shape) for p in layer.parameters() if p.dim() == 2] for layer in gnn.layers]
    assert shapes == [[(64, 3), (64, 64), (64, 64)], *[[(64, 64)] * 3] * 4]


def test_each_point_s_neighbours_are_in_its_own_cloud(points):
    graph = neighbour_graph(points, 5)
    expected = nearest_neighbours(points, 5)
    for b in range(2):
        assert torch.equal(graph[:, b * 30 : (b + 1) * 30].T - b * 30, expected[b])


def test_the_difference_along_edges_passes_gradcheck(points, randn):
    graph = neighbour_graph(points[:, :8], 3)
    h = randn(16, 2, requires_grad=True)
    assert torch.autograd.gradcheck(lambda h: neighbour_difference(h, h, graph), h)


def test_the_gradient_along_edges_reaches_centre_and_neighbour(points, randn, close):
    graph = neighbour_graph(points, 5)
    h, direction = randn(60, 4, requires_grad=True), randn(5, 60, 4)
    ours = neighbour_difference(h, h, graph)
    plain = h - h[graph]
    close(ours, plain)
    close(torch.autograd.grad(ours, h, direction)[0], torch.autograd.grad(plain, h, direction)[0])


def test_the_maximum_over_neighbours_passes_gradcheck(randn):
    assert torch.autograd.gradcheck(neighbour_maximum, randn(4, 6, 3, requires_grad=True))


def test_equal_maxima_each_receive_the_gradient():
    y = torch.tensor([[[1.0]], [[2.0]], [[2.0]]], requires_grad=True)
    neighbour_maximum(y).backward(torch.tensor([[3.0]]))
    assert y.grad.flatten().tolist() == [0, 3, 3]


@MODES
def test_an_edge_layer_s_gradient_reaches_its_input(train, seasoned, points, randn):
    layer, graph = seasoned(EdgeLayer(2, 16), train=train), neighbour_graph(points[:, :8], 3)
    assert torch.autograd.gradcheck(lambda u: layer(u, graph), randn(16, 2, requires_grad=True))


@MODES
def test_permuted_points_give_permuted_features(train, seasoned, points, generator, close):
    gnn, order = seasoned(GNN(neighbours=5), train=train), torch.randperm(30, generator=generator)
    close(gnn(points[:, order]), gnn(points)[:, order])


@MODES
def test_translation_does_not_matter(train, seasoned, points, randn, close):
    gnn = seasoned(GNN(neighbours=5), train=train)
    close(gnn(points + 10 * randn(2, 1, 3)), gnn(points))


def test_single_precision_survives_a_large_offset(seasoned, points, close):
    gnn = seasoned(GNN(neighbours=5), torch.float32)
    points = (points * 256).round().float() / 256  # the offset loses nothing
    close(gnn(points + 1000), gnn(points), atol=1e-3)


def test_in_evaluation_clouds_do_not_see_each_other(seasoned, points, dtype, close):
    gnn, points = seasoned(GNN(neighbours=5), dtype), points.to(dtype)
    close(gnn(points), torch.cat([gnn(points[:1]), gnn(points[1:])]))


def test_only_distances_decide_whose_features_change(seasoned, points):
    gnn = seasoned(GNN(neighbours=5, layers=1))
    moved = points.clone()
    moved[:, 0] += 5  # the far point, which has neighbours but is none
    changed = (gnn(moved - moved.mean(1, keepdim=True)) - gnn(points)).abs().amax(-1) > 1e-9
    assert changed[:, 0].all()
    assert not changed[:, 1:].any()


def test_coincident_points_have_finite_features_and_gradients(seasoned, points):
    gnn = seasoned(GNN(neighbours=5), train=True)
    features = gnn(points[:, :1].expand(2, 30, 3))
    features.sum().backward()
    assert features.isfinite().all()
    assert all(p.grad.isfinite().all() for p in gnn.parameters())


def test_a_cloud_needs_one_point_more_than_neighbours(randn):
    gnn = GNN().double().eval()
    assert gnn(randn(1, 13, 3)).isfinite().all()
    with pytest.raises(ValueError, match=r"12 points .* 13"):
        gnn(randn(1, 12, 3))


@pytest.mark.parametrize(("train", "error"), [(False, 0.05), (True, 0.2)], ids=["eval", "train"])
def test_bfloat16_autocast_stays_close(train, error, seasoned, points):
    gnn = seasoned(GNN(neighbours=5), torch.float32, train=train)
    points = points[:, 1:].float() + 30  # an offset that bfloat16 coordinates would not survive
    exact = gnn(points)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = gnn(points)
    rounded.float().square().sum().backward()
    assert (rounded - exact).norm() < error * exact.norm()
    assert all(p.grad.isfinite().all() for p in gnn.parameters())
