"""Hard and hybrid point elimination."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from idam.network.elimination import Significance, Validity, hybrid_weights, keep_most_significant

MODES = pytest.mark.parametrize("train", [False, True], ids=["eval", "train"])

# hard elimination


@pytest.mark.parametrize("share", [Fraction(1, 6), Fraction(1, 3), Fraction(7, 12), Fraction(1)], ids=str)
def test_a_share_of_the_points_stays_rounded_up_and_three_at_least(share, rand):
    scores = rand(1, 1100, dtype=torch.float32)
    for count in range(1, 1100):
        kept = keep_most_significant(scores[:, :count], float(share)).shape[1]
        assert kept == min(count, max(3, math.ceil(share * count))), count


def test_the_most_significant_points_stay(rand, dtype):
    scores = rand(4, 50, dtype=dtype)
    kept = keep_most_significant(scores, 1 / 6)
    for row, index in zip(scores, kept.tolist(), strict=True):
        dropped = sorted(set(range(50)) - set(index))
        assert len(set(index)) == 9
        assert row[index].min() >= row[dropped].max()


@MODES
def test_significance_is_an_mlp_on_each_point(train, seasoned, linear_norm_relu, randn, dtype, close):
    module = seasoned(Significance(10, 8), dtype, train=train)
    features = randn(2, 12, 10, dtype=dtype)
    first, second, last = module.mlp
    hidden = linear_norm_relu(second, linear_norm_relu(first, features))
    close(module(features), hidden @ last.weight[0] + last.bias)


def test_significance_of_a_point_depends_on_no_other(seasoned, randn, close):
    module, features = seasoned(Significance(10, 8)), randn(2, 12, 10)
    alone = torch.cat([module(features[:, i : i + 1]) for i in range(12)], 1)
    close(module(features), alone)


# hybrid elimination


@MODES
def test_validity_is_the_mlp_of_each_row_s_maximum(train, seasoned, linear_norm_relu, randn, dtype, close):
    module = seasoned(Validity(8), dtype, train=train)
    maximum = randn(2, 6, 8, dtype=dtype)
    first, last = module.mlp
    close(module(maximum), linear_norm_relu(first, maximum) @ last.weight[0] + last.bias)


def weights_above_the_median(validity: np.ndarray) -> np.ndarray:
    """Equation 7; the median of an even number is the lower of the two in the middle."""
    kept = validity >= np.sort(validity)[(len(validity) - 1) // 2]
    return validity * kept / np.sum(validity * kept)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 11, 128])
def test_matches_below_the_median_validity_weigh_nothing(count, rand, dtype):
    validity = rand(5, count, dtype=dtype)
    weight = hybrid_weights(validity, 0.5)
    assert weight.dtype == dtype
    expected = np.stack([weights_above_the_median(row) for row in validity.numpy()])
    np.testing.assert_allclose(weight, expected, rtol=1e-5 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize(("keep", "kept"), [(1.0, 21), (0.75, 16), (0.5, 11), (0.25, 6), (0.1, 3)])
def test_another_share_of_the_matches_can_stay(keep, kept, rand, dtype):
    validity = rand(5, 21, dtype=dtype) + 0.01
    weight = hybrid_weights(validity, keep)
    assert (weight > 0).sum(-1).tolist() == [kept] * 5
    for row, score in zip(weight, validity, strict=True):
        assert set(row.argsort()[-kept:].tolist()) == set(score.argsort()[-kept:].tolist())


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.5, 1.0])
def test_weights_sum_to_one_and_go_with_the_validity(keep, rand, dtype, close):
    validity = rand(5, 40, dtype=dtype)
    weight = hybrid_weights(validity, keep)
    close(weight.sum(-1), torch.ones(5, dtype=dtype))
    ratio = torch.where(weight > 0, weight / validity, torch.nan)
    close(ratio.nan_to_num().amax(-1), ratio.nanmean(-1))


@pytest.mark.parametrize("value", [1e-30, 0.3, 0.7, 1.0])
def test_equal_validity_weighs_equally(value, dtype, close):
    weight = hybrid_weights(torch.full((2, 8), value, dtype=dtype), 0.5)
    close(weight, torch.full((2, 8), 1 / 8, dtype=dtype))


def test_no_validity_at_all_gives_finite_weights(dtype):
    assert hybrid_weights(torch.zeros(2, 8, dtype=dtype), 0.5).isfinite().all()
