"""Matrix products in blocks: those of the definition, for every shape."""

from __future__ import annotations

import numpy as np
import pytest

from idam.describe.products import SMALL, gram, product


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(1, 1, 1), (0, 5, 4), (17, 33, 5), (1000, 32, 1000), (50, 700, 300), (300, 20, 3)])
def test_product_is_that_of_the_definition(shape: tuple[int, int, int], dtype: type) -> None:
    n, k, p = shape
    random = np.random.default_rng(0)
    x, y = random.normal(size=(n, k)).astype(dtype), random.normal(size=(k, p)).astype(dtype)
    expected = np.einsum("nk,kp->np", x.astype(float), y.astype(float))
    found = product(x, y)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4 if dtype is np.float32 else 1e-12)
    out = np.full((n, p), np.nan, dtype)
    assert product(x, y, out) is out
    np.testing.assert_array_equal(out, found)


@pytest.mark.parametrize("count", [0, 1, 5, SMALL // 42 + 1, 40_000])
def test_gram_is_that_of_the_definition(count: int) -> None:
    random = np.random.default_rng(0)
    x, y = random.normal(size=(count, 6)), random.normal(size=(count, 7))
    np.testing.assert_allclose(gram(x, y), np.einsum("nk,np->kp", x, y), atol=1e-9)
