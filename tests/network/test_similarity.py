"""The similarity matrix convolution against its definition, with the (2K + 4)-channel tensor built."""

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from idam.network.similarity import SimilarityConvolution, pair_geometry

MODES = pytest.mark.parametrize("train", [False, True], ids=["eval", "train"])


@pytest.fixture
def clouds(randn, dtype) -> tuple[Tensor, ...]:
    """Two pairs of clouds of different sizes with features of 10 channels."""
    return tuple(randn(*shape, dtype=dtype) for shape in [(2, 7, 3), (2, 9, 3), (2, 7, 10), (2, 9, 10)])


@pytest.fixture
def direct(linear_norm_relu):
    """Equation 2 and the convolutions after it, pair by pair."""

    def run(module: SimilarityConvolution, p: Tensor, q: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        def vector(b: int, i: int, j: int) -> Tensor:
            offset = p[b, i] - q[b, j]
            distance = offset.norm().view(1)
            return torch.cat([u[b, i], v[b, j], distance, offset / distance])

        pairs = torch.stack(
            [
                torch.stack([torch.stack([vector(b, i, j) for j in range(q.shape[1])]) for i in range(p.shape[1])])
                for b in range(p.shape[0])
            ]
        )
        for layer in (module.first, *module.hidden):
            pairs = linear_norm_relu(layer, pairs)
        return pairs, (pairs @ module.score.weight.T + module.score.bias).squeeze(-1)

    return run


@MODES
def test_the_convolution_is_its_definition(train, seasoned, clouds, direct, dtype, close):
    module = seasoned(SimilarityConvolution(10, 8), dtype, train=train)
    pairs = module.pair_features(*clouds)
    maximum, score = module(*clouds)
    assert pairs.shape == (2, 7, 9, 8)
    assert score.shape == (2, 7, 9)
    expected_pairs, expected_score = direct(module, *clouds)
    close(pairs, expected_pairs)
    close(maximum, expected_pairs.amax(2))
    close(score, expected_score)


@MODES
def test_its_gradient_is_that_of_its_definition(train, seasoned, clouds, direct, same_gradients):
    module, clouds = seasoned(SimilarityConvolution(10, 8), train=train), [x.double() for x in clouds]
    same_gradients(module, module(*clouds)[1], direct(module, *clouds)[1])


class LargestTensor(TorchDispatchMode):
    """The most elements of any tensor that an operation returned."""

    elements = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **kwargs or {})
        for tensor in result if isinstance(result, (tuple, list)) else [result]:
            if isinstance(tensor, Tensor):
                self.elements = max(self.elements, tensor.numel())
        return result


@MODES
@pytest.mark.parametrize("gradients", [False, True])
def test_the_tensor_of_all_channels_is_never_built(train, gradients, seasoned, randn):
    module = seasoned(SimilarityConvolution(500, 8), train=train)
    with torch.set_grad_enabled(gradients), LargestTensor() as largest:
        module(randn(1, 90, 3), randn(1, 80, 3), randn(1, 90, 500), randn(1, 80, 500))
    assert largest.elements == 90 * 80 * 8


def test_pair_geometry_is_distance_and_direction(randn, dtype, close):
    source, target = randn(2, 5, 3, dtype=dtype), randn(2, 4, 3, dtype=dtype)
    geometry = pair_geometry(source, target)
    for b, i, j in torch.cartesian_prod(torch.arange(2), torch.arange(5), torch.arange(4)):
        offset = source[b, i] - target[b, j]
        close(geometry[b, i, j, 0], offset.square().sum().sqrt())
        close(geometry[b, i, j, 1:] * geometry[b, i, j, 0], offset)


def test_coincident_points_have_no_direction(randn, dtype):
    points = randn(2, 5, 3, dtype=dtype)
    geometry = pair_geometry(points, points)
    assert geometry.isfinite().all()
    assert (geometry.diagonal(dim1=1, dim2=2) == 0).all()


def test_coincident_points_have_finite_scores_and_gradients(seasoned, clouds, dtype):
    module = seasoned(SimilarityConvolution(10, 8), dtype, train=True)
    source, _, features, _ = clouds
    source.requires_grad_()
    pairs, score = module(source, source, features, features)
    (pairs.sum() + score.sum()).backward()
    assert score.isfinite().all()
    assert source.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in module.parameters())


def test_permuted_points_give_permuted_scores(seasoned, clouds, generator, dtype, close):
    module = seasoned(SimilarityConvolution(10, 8), dtype)
    rows, columns = torch.randperm(7, generator=generator), torch.randperm(9, generator=generator)
    source, target, source_features, target_features = clouds
    _, score = module(source[:, rows], target[:, columns], source_features[:, rows], target_features[:, columns])
    close(score, module(*clouds)[1][:, rows][:, :, columns])


@MODES
def test_bfloat16_autocast_stays_close(train, seasoned, clouds):
    module, clouds = seasoned(SimilarityConvolution(10, 8), torch.float32, train=train), [x.float() for x in clouds]
    _, exact = module(*clouds)
    with torch.autocast("cpu", torch.bfloat16):
        _, rounded = module(*clouds)
    assert (rounded - exact).norm() < 0.05 * exact.norm()
