"""The scale that a rigid transform leaves over."""

from __future__ import annotations

import numpy as np
import pytest

from idam import register, rigid
from idam.align import align
from idam.align.patches import Pairs
from idam.align.scale import residual_scale
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from solids import potato

TRUTH = rigid.exp(np.array([0.4, -0.3, 0.2, 0.1, 0.2, -0.3]))


def clouds(seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Two samplings, each of three quarters of a shape; the target is moved."""
    rng = np.random.default_rng(seed)
    source, target = potato(6000, 2 * seed), potato(6000, 2 * seed + 1)
    source, target = source[source[:, 0] < np.quantile(source[:, 0], 0.75)], target[target[:, 1] < 0.4]
    source, target = (points + noise * rng.normal(size=points.shape) for points in (source, target))
    return source, rigid.apply(TRUTH, target)


@pytest.mark.parametrize(
    ("scale", "noise"), [(x, 0.001) for x in (1.02, 0.98, 1.05, 0.95, 1.1, 0.9)] + [(x, 0.005) for x in (1.05, 0.9)]
)
def test_scale_is_found(scale: float, noise: float) -> None:
    source, target = clouds(0, noise)
    surfaces = Surfaces(Surface.of(source / scale), Surface.of(target), spacing_of(target))
    answer = align(surfaces, TRUTH, 2.0, "gicp")
    assert residual_scale(surfaces, answer, Pairs.of_points(surfaces, answer)) == pytest.approx(scale, abs=0.006)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.02])
@pytest.mark.parametrize("seed", range(3))
def test_equal_scale_is_no_finding(seed: int, noise: float) -> None:
    source, target = clouds(seed, noise)
    surfaces = Surfaces(Surface.of(source), Surface.of(target), spacing_of(target))
    answer = align(surfaces, TRUTH, 2.0, "gicp")
    assert residual_scale(surfaces, answer, Pairs.of_points(surfaces, answer)) == 1.0


def test_where_nothing_touches_there_is_no_finding() -> None:
    source, target = clouds(0, 0.001)
    surfaces = Surfaces(Surface.of(source), Surface.of(target), spacing_of(target))
    away = rigid.exp(np.array([0, 0, 0, 50.0, 0, 0]))
    assert residual_scale(surfaces, away, Pairs.of_points(surfaces, away)) == 1.0


def test_a_remark_says_which_is_larger() -> None:
    source, target = clouds(0, 0.002)
    for clouds_given, word in (((1.1 * source, target), "10 % larger"), ((target, 1.1 * source), "9 % smaller")):
        result = register(*clouds_given)
        assert word in result.remark
        assert word in repr(result)
        assert result.to_dict()["remark"] == result.remark
    assert register(source, target).remark == ""
