"""Voxel grids and the ladder of their sizes."""

from __future__ import annotations

import numpy as np
import pytest

from idam.clouds.voxels import ENOUGH, STEPS, downsample, ladder, occupied, rung, rung_for
from solids import ball


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def dense() -> np.ndarray:
    """A unit sphere of 6000 points."""
    return ball(6000, 0)


# --- the ladder ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [-400, -41, -1, 0, 1, 2, 3, 4, 55, 400])
def test_rung_undoes_ladder(step: int) -> None:
    assert rung(ladder(step)) == step
    assert rung(1.08 * ladder(step)) == rung(ladder(step) / 1.08) == step
    assert ladder(step + STEPS) == 2 * ladder(step)


def test_nearest_rung_is_within_half_a_step(random: np.random.Generator) -> None:
    for length in 10.0 ** random.uniform(-30, 30, 100):
        assert abs(np.log2(ladder(rung(length)) / length)) <= 0.5 / STEPS + 1e-12


# --- the grid ------------------------------------------------------------------------------------------------------


def cells(points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The occupied voxels (M, 3), and the row of that of each point (N,)."""
    found, index = np.unique(np.floor(points / size), axis=0, return_inverse=True)
    return found, index.ravel()


@pytest.mark.parametrize("size", [0.01, 0.13, 0.25, 3.0])
def test_downsample_is_the_mean_of_each_voxel(dense: np.ndarray, size: float) -> None:
    voxels, index = cells(dense, size)
    sums = np.zeros((len(voxels), 3))
    np.add.at(sums, index, dense)
    means = sums / np.bincount(index)[:, None]
    found = downsample(dense, size)
    np.testing.assert_allclose(found[np.lexsort(found.T)], means[np.lexsort(means.T)], atol=1e-12)
    np.testing.assert_array_equal(found, downsample(dense, size))
    assert occupied(dense, size) == len(voxels)


def test_order_of_the_points_changes_last_bits_of_the_means_alone(
    random: np.random.Generator, dense: np.ndarray
) -> None:
    found, shuffled = downsample(dense, 0.25), downsample(random.permutation(dense), 0.25)
    np.testing.assert_allclose(shuffled, found, rtol=0, atol=1e-14)


def test_powers_of_two_change_no_digit(dense: np.ndarray) -> None:
    for unit in (2.0**-30, 0.5, 2.0**20):
        np.testing.assert_array_equal(downsample(unit * dense, unit * 0.2), unit * downsample(dense, 0.2))


def test_voxels_are_counted_however_far_the_points() -> None:
    ends = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    far = np.vstack([ends, 1e9 * ends, 1e100 * ends])
    assert occupied(far, 0.1) == 4  # the far ones share the corners of the grid


# --- which rung ----------------------------------------------------------------------------------------------------


@pytest.fixture(params=["surface", "curve", "volume", "hardly more than asked for", "two sizes", "copies"])
def crowd(request: pytest.FixtureRequest, random: np.random.Generator, dense: np.ndarray) -> np.ndarray:
    """Clouds whose voxels grow in number with different powers of their size."""
    return {
        "surface": dense,
        "curve": random.uniform(-1, 1, (6000, 1)) * [1.0, 0.01, 0.01],
        "volume": random.uniform(-1, 1, (6000, 3)),
        "hardly more than asked for": dense[:510],
        "two sizes": np.vstack([dense, 0.02 * dense + [0.9, 0, 0]]),
        "copies": np.repeat(dense[:700], 9, axis=0),
    }[request.param]


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("count", [100, 500])
def test_leaves_at_most_the_count_and_the_next_finer_too_many_or_enough_are_left(
    crowd: np.ndarray, count: int, unit: float
) -> None:
    points = unit * crowd
    step = rung_for(points, count, unit)
    assert step is not None
    left = len(downsample(points, ladder(step)))
    assert left == occupied(points, ladder(step))
    assert left <= count
    assert left >= ENOUGH * count or occupied(points, ladder(step - 1)) > count


def test_follows_from_the_points_in_any_order(random: np.random.Generator, crowd: np.ndarray) -> None:
    for count in (50, 300):
        expected = rung_for(crowd, count, 1.0)
        for _ in range(3):
            assert rung_for(random.permutation(crowd), count, 1.0) == expected


def test_more_points_asked_for_take_no_larger_voxels(crowd: np.ndarray) -> None:
    steps = [rung_for(crowd, count, 1.0) for count in (30, 60, 120, 240, 480)]
    assert all(step is not None for step in steps)
    assert steps == sorted(steps, reverse=True)  # type: ignore[type-var]


def test_no_voxels_where_there_are_no_more_points(dense: np.ndarray) -> None:
    assert rung_for(dense[:500], 500, 1.0) is None
    assert rung_for(dense[:501], 500, 1.0) is not None


def test_copies_of_few_points_leave_them_all(dense: np.ndarray) -> None:
    few = dense[:400]
    step = rung_for(np.repeat(few, 20, axis=0), 500, 1.0)
    assert step is not None
    assert len(downsample(few, ladder(step))) > 0.9 * len(few)


def test_points_on_a_lattice_leave_no_more_than_the_count() -> None:
    steps = np.linspace(-1, 1, 12)
    lattice = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    step = rung_for(lattice, 500, 3**0.5)
    assert step is not None
    # whole layers of voxels fill at once
    assert len(downsample(lattice, ladder(step))) <= 500 < len(downsample(lattice, ladder(step - 1)))
