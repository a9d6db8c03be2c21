"""The scope: what is looked into, and what is not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from idam.network.geometry import random_rotation
from idam.search.scope import Scope
from motions import rigid


def turn(degrees: float) -> np.ndarray:
    return rigid([0.0, 0.0, np.radians(degrees)], [0.0, 0.0, 0.1])


def test_counts_from_the_guess() -> None:
    turns = [turn(degrees) for degrees in (0, 30, 60, 90, 180)]
    kept = Scope(turns[2], 45.0).within(turns)
    assert [answer.transformation for answer in kept] == turns[1:4]
    assert len(Scope(turns[2]).within(turns)) == 5
    assert len(Scope(turns[2], 30.0).within(turns)) == 3


@pytest.mark.parametrize("max_angle", [0.01, 40.0, 180.0])
def test_rotations_turn_on_from_the_guess(max_angle: float) -> None:
    rotations = torch.cat([torch.eye(3)[None], random_rotation(200, generator=torch.Generator().manual_seed(1))])
    guess = turn(70)
    kept = Scope(guess, max_angle).turns(rotations)
    angle = torch.rad2deg(torch.arccos(((rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    expected = rotations[angle <= max_angle] @ torch.as_tensor(guess[:3, :3]).float()
    torch.testing.assert_close(kept, expected)
    assert len(kept) >= 1


def test_a_scope_within_a_scope_does_not_leave_it() -> None:
    scope = Scope(turn(10), 90.0)
    assert scope.around(turn(30), 20.0).max_angle == 20.0
    narrowed = scope.around(turn(85), 20.0)
    assert narrowed.max_angle == pytest.approx(15.0)
    np.testing.assert_array_equal(narrowed.guess, turn(85))
    assert [len(narrowed.within([turn(degrees)])) for degrees in (69, 71, 99, 101)] == [0, 1, 1, 0]
