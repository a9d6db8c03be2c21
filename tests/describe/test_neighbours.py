"""Nearest neighbours: those of all distances, never the point itself, copies of points included."""

import numpy as np
import pytest

from idam.describe.neighbours import Reach, nearest_neighbours, within_reach
from idam.describe.products import product


def all_distances(points: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return distance


def test_they_are_those_of_all_distances_and_never_the_point_itself() -> None:
    points = np.random.default_rng(0).random((60, 3))
    points[20:30] = points[20]  # copies, more than are asked for
    distance, near = nearest_neighbours(points, 6)
    assert near.shape == (60, 6)
    assert (near != np.arange(60)[:, None]).all()
    assert all(len(set(row)) == 6 for row in near.tolist())
    everything = all_distances(points)
    np.testing.assert_allclose(distance, np.sort(everything, 1)[:, :6], atol=1e-12)
    np.testing.assert_allclose(np.take_along_axis(everything, near, 1), distance, atol=1e-12)
    assert (distance[20:30] == 0).all()


def test_a_cloud_smaller_than_asked_for_has_all_others_as_neighbours() -> None:
    distance, near = nearest_neighbours(np.random.default_rng(1).random((5, 3)).astype(np.float32), 16)
    assert near.shape == distance.shape == (5, 4)
    assert distance.dtype == np.float32
    assert [sorted(row) for row in near.tolist()] == [[j for j in range(5) if j != i] for i in range(5)]


@pytest.mark.parametrize(
    "reach", [Reach(0.3, at_most=8), Reach(0.3, at_most=1000), Reach(0.05, at_most=20, at_least=2)]
)
def test_within_reach_are_the_nearest_within_the_radius(reach: Reach) -> None:
    points = np.random.default_rng(0).random((300, 3))
    near = within_reach(*nearest_neighbours(points, reach.at_most), reach)
    for row, distance in enumerate(all_distances(points)):
        within = int((distance < reach.radius).sum())
        expected = distance.argsort()[: min(max(within, reach.at_least), reach.at_most)]
        assert near.neighbour[near.centre == row].tolist() == expected.tolist()
    assert near.counts.tolist() == np.bincount(near.centre, minlength=300).tolist()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_no_numbers_are_refused(value: float) -> None:
    points = np.zeros((10, 3))
    points[3, 1] = value
    with pytest.raises(ValueError, match="must be finite"):
        nearest_neighbours(points, 3)


@pytest.mark.parametrize("shapes", [(1, 5, 96), (1000, 96, 96), (2000, 5, 96), (700, 32, 900), (40, 300_000, 2)])
def test_a_product_in_blocks_is_the_product(shapes: tuple[int, int, int]) -> None:
    rows, inner, columns = shapes
    rng = np.random.default_rng(0)
    x, y = (rng.standard_normal(shape).astype(np.float32) for shape in ((inner, rows), (inner, columns)))
    expected = x.T.astype(float) @ y.astype(float)
    np.testing.assert_allclose(product(x.T, y), expected, atol=1e-6 * inner, rtol=1e-5)
