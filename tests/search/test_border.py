"""What only one cloud shows, past the other's border or amid it."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.surfaces import Surface, Surfaces
from idam.search.sparse.border import ALONE, SHARP, SHRINK, mixing
from motions import move, rigid
from solids import distances

SPACING = 0.05
STAY = np.eye(4)


def sheet(low: float, high: float, seed: int = 0) -> np.ndarray:
    """A wavy sheet between two values of x, points about a spacing apart."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(low, high, int(400 * (high - low))), rng.uniform(-0.5, 0.5, int(400 * (high - low)))
    return np.stack([x, y, 0.1 * np.sin(4 * x)], 1)


def pair(source: np.ndarray, target: np.ndarray) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), SPACING)


def test_nothing_alone_is_nothing_mixed() -> None:
    same = sheet(-1, 1)
    assert mixing(pair(same, same), STAY) == 0.0


def test_past_the_border_is_better_than_amid() -> None:
    whole = sheet(-1, 1)
    left = whole[whole[:, 0] < 0.3]
    right = whole[whole[:, 0] > -0.3]
    beside = mixing(pair(left, right), STAY)
    # a hole that the other cloud fills: it ought to have been seen
    holed = whole[np.abs(whole[:, 0]) > 0.35]
    amid = mixing(pair(whole, holed), STAY)
    assert beside < 0.3 < 0.5 < amid


def test_a_right_pose_mixes_less_than_one_shifted_along_the_surface() -> None:
    source, target = sheet(-1, 0.3, seed=1), sheet(-0.4, 1, seed=2)
    slid = rigid([0.0, 0.0, 0.0], [0.2, 0.5, 0.0])  # beside each other along y, where neither ends
    assert mixing(pair(source, target), STAY) < mixing(pair(source, target), slid)


def test_swapping_and_moving_both_change_nothing() -> None:
    source, target = sheet(-1, 0.3, seed=1), sheet(-0.4, 1, seed=2)
    pose, motion = rigid([0.1, 0.2, -0.1], [0.1, 0.1, 0.0]), rigid([1.0, -0.4, 0.2], [0.0, 0.0, 0.0])
    expected = mixing(pair(source, target), pose)
    assert mixing(pair(target, source), np.linalg.inv(pose)) == pytest.approx(expected, abs=1e-9)
    # about the origin, for the plane's pull towards flatness knows of it
    turned = move(motion, target)
    assert mixing(pair(source, turned), motion @ pose) == pytest.approx(expected, abs=1e-6)


def test_it_is_the_least_cross_entropy_that_a_plane_has() -> None:
    source, target = sheet(-1, 0.3, seed=1), sheet(-0.4, 1, seed=2)
    expected = 0.0
    for own, other in ((source, target), (target, source)):
        apart = distances(other, own).min(1)
        points = np.concatenate([own, other[apart > ALONE * SPACING]])
        inputs, labels = np.c_[SHARP * points, np.ones(len(points))], np.arange(len(points)) >= len(own)
        plane, before = np.zeros(4), np.zeros(4)
        for n in range(5000):  # Nesterov's gradient descent, slow and sure
            ahead = plane + n / (n + 3) * (plane - before)
            chance = 1 / (1 + np.exp(-inputs @ ahead))
            gradient = inputs.T @ (chance - labels) / len(inputs) + SHRINK * ahead * [1, 1, 1, 0]
            before, plane = plane, ahead - 0.3 * gradient
        assert np.abs(gradient).max() < 1e-3
        logit = inputs @ plane
        expected += float((np.logaddexp(0, logit) - labels * logit).mean())
    assert mixing(pair(source, target), STAY) == pytest.approx(expected, abs=0.01)


def test_clouds_that_nowhere_touch_are_told_apart() -> None:
    far = rigid([0.0, 0.0, 0.0], [9.0, 0.0, 0.0])
    assert np.isfinite(mixing(pair(sheet(-1, 1), sheet(-1, 1, seed=3)), far))
