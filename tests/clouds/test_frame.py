"""Where a cloud is and how large, and whether it can be registered at all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from idam.clouds.frame import MIN_POINTS, STRAY, check_points, core, without_strays
from idam.errors import InputError
from motions import any_rotation
from solids import noise

ORIGIN = np.zeros(3)
UTM = np.array([5e5, 5.6e6, 100.0])
PLACES = pytest.mark.parametrize("place", [ORIGIN, UTM], ids=["at the origin", "UTM"])


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def sheet(random: np.random.Generator) -> np.ndarray:
    """A bent sheet of 3 by 2 by 1 units, 600 points, about 0.1 apart."""
    x, y = random.uniform(-1, 1, (2, 600))
    return np.stack([1.5 * x, y, np.sin(2 * x) * np.cos(y) / 2], 1)


def refusal(points: np.ndarray, name: str = "a.ply") -> str:
    with pytest.raises(InputError) as error:
        check_points(points, name)
    message = str(error.value)
    assert message.startswith(f"{name}: ")
    assert "\n" not in message
    return message


# --- the core ------------------------------------------------------------------------------------------------------


@PLACES
@pytest.mark.parametrize("unit", [1e-3, 0.3048, 1000.0])
def test_core_moves_and_grows_along(sheet: np.ndarray, place: np.ndarray, unit: float) -> None:
    (centre, radius), (there, wider) = core(sheet), core(unit * sheet + place)
    rounding = 2e-9 if place.any() else 1e-12 * unit  # float64 at 5.6e6 has steps of 1e-9
    np.testing.assert_allclose(there, unit * centre + place, rtol=0, atol=rounding)
    assert wider == pytest.approx(unit * radius, rel=1e-12, abs=4 * rounding)


def test_core_turns_along(random: np.random.Generator) -> None:
    points = noise(800, 0) * [1.0, 0.6, 0.3]
    centre, radius = core(points)
    for _ in range(3):
        turn = any_rotation(random)
        turned, same = core(points @ turn.T)
        # the median of coordinates is that of other points, which says where strays begin and no more
        np.testing.assert_allclose(turned, turn @ centre, atol=0.02 * radius)
        assert same == pytest.approx(radius, rel=0.05)


def test_most_points_lie_within_the_radius_and_it_is_no_larger_than_it_must_be(sheet: np.ndarray) -> None:
    centre, radius = core(sheet)
    distance = np.linalg.norm(sheet - centre, axis=1)
    assert 0.97 < (distance <= radius * (1 + 1e-12)).mean() <= 1.0
    assert radius <= distance.max()
    np.testing.assert_allclose(centre, sheet.mean(0), atol=0.05)


@pytest.mark.parametrize("share", [0.001, 0.01, 0.03, 0.08])
@pytest.mark.parametrize("times", [50.0, 1e3, 1e9, 1e50])
def test_strays_change_next_to_nothing(sheet: np.ndarray, share: float, times: float) -> None:
    centre, radius = core(sheet)
    strays = times * radius * np.array([1.0, 0.3, -0.2]) + noise(max(1, int(share * len(sheet))), 1)
    strayed, wider = core(np.vstack([sheet, strays]))
    np.testing.assert_allclose(strayed, centre, atol=0.05 * radius)
    assert wider == pytest.approx(radius, rel=0.05)
    assert len(without_strays(np.vstack([sheet, strays]) - strayed, wider)) == len(sheet)


def test_order_of_the_points_changes_no_more_than_rounding(random: np.random.Generator, sheet: np.ndarray) -> None:
    (centre, radius), (other, same) = core(sheet), core(random.permutation(sheet))
    np.testing.assert_allclose(other, centre, rtol=0, atol=1e-14)
    assert same == pytest.approx(radius, rel=1e-14)


@pytest.mark.parametrize("layout", [np.asfortranarray, lambda points: np.repeat(points, 2, axis=0)[::2]])
def test_layout_in_memory_does_not_matter(sheet: np.ndarray, layout: Callable[[np.ndarray], np.ndarray]) -> None:
    (centre, radius), (other, same) = core(sheet), core(layout(sheet))
    np.testing.assert_array_equal(other, centre)
    assert same == radius


def test_strays_are_what_lies_beyond_so_many_radii(random: np.random.Generator) -> None:
    directions = random.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = np.concatenate([random.uniform(0, 0.99 * STRAY, 200), STRAY * 10 ** random.uniform(0.01, 90, 100)])
    points = 3.0 * directions * distance[:, None]
    np.testing.assert_array_equal(without_strays(points, 3.0), points[:200])


# --- what cannot be registered -------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, MIN_POINTS - 1])
def test_too_few_points(sheet: np.ndarray, count: int) -> None:
    assert f"has {count} points, at least {MIN_POINTS} are needed" in refusal(sheet[:count])


def test_just_enough_points(sheet: np.ndarray) -> None:
    check_points(sheet[:MIN_POINTS], "a.ply")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_values_that_are_no_numbers(sheet: np.ndarray, value: float) -> None:
    sheet[7, 2] = sheet[9] = value
    assert "2 of 600 points are NaN or infinite" in refusal(sheet, "source")


@pytest.mark.parametrize("place", [ORIGIN, UTM, np.full(3, 1 / 3)], ids=["at the origin", "UTM", "not a binary number"])
def test_points_all_equal(place: np.ndarray) -> None:
    assert "all points are equal" in refusal(np.tile(place, (50, 1)))


@pytest.mark.parametrize(("place", "extent"), [(ORIGIN, 1e-3), (ORIGIN, 1.0), (UTM, 1.0), (UTM, 1e4)])
def test_points_on_a_line(random: np.random.Generator, place: np.ndarray, extent: float) -> None:
    line = random.uniform(size=(100, 1)) * extent * np.array([0.3, -0.8, 0.5]) + place
    assert "all points lie on a line" in refusal(line)
    assert "line" in refusal(np.vstack([line, line[:1] + 1e6 * extent]))  # a stray makes no surface of it


def test_two_places_are_a_line() -> None:
    assert "line" in refusal(np.repeat([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], 20, axis=0))


@PLACES
@pytest.mark.parametrize("extent", [1e-3, 1.0, 1e4])
def test_a_plane_passes(random: np.random.Generator, place: np.ndarray, extent: float) -> None:
    plane = random.uniform(size=(100, 2)) @ np.array([[1.0, 0.2, 0.3], [0.1, 0.9, -0.4]])
    check_points(extent * plane + place, "a.ply")


def test_a_stray_point_makes_no_line_of_a_surface(sheet: np.ndarray) -> None:
    check_points(np.vstack([sheet + UTM, np.zeros((1, 3))]), "a.ply")  # a scanner's (0, 0, 0) for "no return"
    check_points(np.vstack([sheet, [[1e9, 0, 0]]]), "a.ply")


def test_checks_leave_the_points_as_they_were(sheet: np.ndarray) -> None:
    before = sheet.copy()
    check_points(sheet, "a.ply")
    np.testing.assert_array_equal(sheet, before)
