"""FPFH as a module: NumPy's histograms, of any batch, dtype and device."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from idam.describe.fpfh import fpfh
from idam.describe.normals import estimate_normals
from idam.network.features.fpfh import FPFH
from shapes import SHAPES, degenerate_clouds, make_cloud


@pytest.fixture
def clouds() -> Tensor:
    """(B, N, 3), float64."""
    return torch.from_numpy(np.stack([make_cloud(shape) for shape in SHAPES]))


def test_they_are_numpy_s_of_each_cloud(clouds):
    for points, features in zip(clouds.numpy(), FPFH()(clouds), strict=True):
        normals = estimate_normals(points, radius=0.1, max_neighbours=30)
        expected = fpfh(points, normals, radius=0.2, max_neighbours=100)
        assert_close(features, torch.from_numpy(expected), rtol=0, atol=0)
    assert FPFH.channels == 33


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("name", degenerate_clouds())
def test_degenerate_input_gives_finite_features(name, dtype):
    features = FPFH()(torch.from_numpy(degenerate_clouds()[name]).to(dtype)[None])
    assert features.dtype == dtype
    assert features.isfinite().all()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_points_that_are_no_numbers_are_refused(value, clouds):
    clouds[0, 3, 1] = value
    with pytest.raises(ValueError, match="must be finite"):
        FPFH()(clouds)


def test_autocast_changes_nothing(clouds):
    with torch.autocast("cpu", torch.bfloat16):
        features = FPFH()(clouds.float())
    assert_close(features, FPFH()(clouds.float()), rtol=0, atol=0)


def test_needs_no_gradient(clouds):
    assert not FPFH()(clouds.requires_grad_()).requires_grad


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_gpu_equals_cpu(clouds):
    assert_close(FPFH()(clouds.cuda()).cpu(), FPFH()(clouds), rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(100, 3), (2, 100, 4), (0, 100, 3), (2, 0, 3)])
def test_refuses_what_is_not_a_batch_of_clouds(shape):
    with pytest.raises(ValueError, match=r"\(B, N, 3\)"):
        FPFH()(torch.zeros(shape))
