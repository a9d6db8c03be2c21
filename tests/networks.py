"""Fixtures of tests that need torch: precision, randomness, and the network's building block written out."""

from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from idam.network.layers import NormalisedLinear

__all__ = [
    "_same_weights_every_time",
    "assert_rotations",
    "close",
    "dtype",
    "generator",
    "linear_norm_relu",
    "one_thread",
    "rand",
    "randn",
    "same_gradients",
    "seasoned",
]
"""The fixtures, which the conftest.py of each folder that needs them imports all at once."""

TOLERANCE = {torch.float32: {"rtol": 1e-5, "atol": 1e-5}, torch.float64: {"rtol": 1e-10, "atol": 1e-10}}


@pytest.fixture(autouse=True)
def _same_weights_every_time() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def randn(generator: torch.Generator) -> Callable[..., Tensor]:
    """Seeded standard normals, float64 unless the call says otherwise."""
    return partial(torch.randn, generator=generator, dtype=torch.float64)


@pytest.fixture
def rand(generator: torch.Generator) -> Callable[..., Tensor]:
    """Seeded uniforms in [0, 1), float64 unless the call says otherwise."""
    return partial(torch.rand, generator=generator, dtype=torch.float64)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As processes that share the cores have: sums in another order round otherwise, and steps can hang on that."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def close() -> Callable[..., None]:
    """Asserts equality to 1e-5 in float32 and to 1e-10 in float64."""

    def check(actual: Tensor, expected: Tensor, **tolerance: float) -> None:
        assert_close(actual, expected, **(TOLERANCE[actual.dtype] | tolerance))

    return check


@pytest.fixture
def assert_rotations(close: Callable[..., None]) -> Callable[[Tensor], None]:
    """Asserts that matrices (..., 3, 3) are orthogonal with determinant +1."""

    def check(rotation: Tensor) -> None:
        close(rotation @ rotation.mT, torch.eye(3, dtype=rotation.dtype).expand_as(rotation))
        close(torch.linalg.det(rotation), torch.ones(rotation.shape[:-2], dtype=rotation.dtype))

    return check


@pytest.fixture
def seasoned(generator: torch.Generator) -> Callable[..., nn.Module]:
    """Gives a module the norms of one that has been trained, so that folding them into the weights matters."""

    def season(module: nn.Module, dtype: torch.dtype = torch.float64, *, train: bool = False) -> nn.Module:
        for norm in module.modules():
            if isinstance(norm, nn.BatchNorm1d):
                norm.running_mean.normal_(0.0, 0.1, generator=generator)
                norm.running_var.uniform_(0.1, 0.5, generator=generator)
                norm.weight.data.uniform_(0.5, 1.5, generator=generator)
                norm.bias.data.normal_(0.0, 0.1, generator=generator)
        return module.to(dtype).train(train)

    return season


@pytest.fixture
def linear_norm_relu() -> Callable[[NormalisedLinear, Tensor], Tensor]:
    """The building block by definition: a linear map, then batch normalisation, then ReLU, one after the other."""

    def apply(layer: NormalisedLinear, x: Tensor) -> Tensor:
        x = x @ layer.linear.weight.T
        if layer.training:
            variance, mean = torch.var_mean(x.flatten(0, -2), 0, correction=0)
        else:
            variance, mean = layer.norm.running_var, layer.norm.running_mean
        x = (x - mean) / (variance + layer.norm.eps).sqrt() * layer.norm.weight + layer.norm.bias
        return x.clamp_min(0)

    return apply


@pytest.fixture
def same_gradients(randn: Callable[..., Tensor], close: Callable[..., None]) -> Callable[..., None]:
    """Asserts that two outputs of one module have the same gradient with respect to its parameters."""

    def check(module: nn.Module, one: Tensor, other: Tensor) -> None:
        direction = randn(*one.shape, dtype=one.dtype)
        parameters = list(module.parameters())
        gradients = (torch.autograd.grad(out, parameters, direction, allow_unused=True) for out in (one, other))
        for actual, expected in zip(*gradients, strict=True):
            assert (actual is None) == (expected is None)
            if actual is not None:
                close(actual, expected)

    return check
