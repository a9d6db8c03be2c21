"""The scope: what is looked into, and what is not."""

from __future__ import annotations

import numpy as np
import pytest

from idam.search.scope import Scope
from motions import any_rotation, degrees, rigid


def turn(angle: float) -> np.ndarray:
    return rigid([0.0, 0.0, np.radians(angle)], [0.0, 0.0, 0.1])


def test_counts_from_the_guess() -> None:
    turns = np.array([turn(angle) for angle in (0, 30, 60, 90, 180)])
    np.testing.assert_array_equal(Scope(turns[2], 45.0).within(turns), turns[1:4])
    assert len(Scope(turns[2]).within(turns)) == 5
    assert len(Scope(turns[2], 30.0).within(turns)) == 3  # rounding rules out neither end
    assert Scope(turns[2], 45.0).within(turns[:0]).shape == (0, 4, 4)


@pytest.mark.parametrize("max_angle", [0.01, 40.0, 179.0, 180.0])
def test_keeps_what_turns_no_further_than_it_may(max_angle: float) -> None:
    random = np.random.default_rng(1)
    guess = turn(70)
    transforms = np.tile(guess, (200, 1, 1))
    transforms[1:, :3, :3] = [any_rotation(random) for _ in range(199)]
    angles = np.array([degrees(guess, matrix) for matrix in transforms])
    scope = Scope(guess, max_angle)
    np.testing.assert_allclose(np.degrees(scope.turned(transforms)), angles, atol=1e-6)
    np.testing.assert_array_equal(scope.within(transforms), transforms[angles <= max_angle])


def test_a_scope_within_a_scope_does_not_leave_it() -> None:
    scope = Scope(turn(10), 90.0)
    assert scope.around(turn(30), 20.0).max_angle == 20.0
    narrowed = scope.around(turn(85), 20.0)
    assert narrowed.max_angle == pytest.approx(15.0)
    np.testing.assert_array_equal(narrowed.guess, turn(85))
    assert [len(narrowed.within(turn(angle)[None])) for angle in (69, 71, 99, 101)] == [0, 1, 1, 0]
