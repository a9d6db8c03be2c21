"""A transform as a turn about the source's centroid and a shift."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.report.motion import motion_of

ORIGIN, GRID = np.zeros(3), np.array([512_300.0, 5_403_200.0, 320.0])


@pytest.mark.parametrize("place", [ORIGIN, GRID], ids=["at the origin", "in a national grid"])
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, np.pi - 1e-6, np.pi])
def test_motion_moves_points_as_the_transform_does(place: np.ndarray, angle: float) -> None:
    random = np.random.default_rng(0)
    points = random.normal(scale=50, size=(100, 3)) + place
    axis = random.normal(size=3)
    turn = rigid.rotation_exp(angle * axis / np.linalg.norm(axis))
    middle = points.mean(0)
    transformation = rigid.transform(turn, middle + np.array([3.0, -2.0, 1.0]) - turn @ middle)
    motion = motion_of(transformation, points)
    assert motion.degrees == pytest.approx(np.degrees(angle), abs=1e-6)
    assert np.linalg.norm(motion.axis) == pytest.approx(1)
    np.testing.assert_allclose(motion.shift, [3.0, -2.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(motion.apply(points), rigid.apply(transformation, points), atol=1e-6)


def test_points_that_are_not_finite_have_no_part_in_the_centroid() -> None:
    points = np.arange(12.0).reshape(4, 3)
    with_gap = np.concatenate([points, [[np.nan, 0, 0]]])
    np.testing.assert_array_equal(motion_of(np.eye(4), with_gap).centroid, points.mean(0))
