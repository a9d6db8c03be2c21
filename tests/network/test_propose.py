"""What a network of the paper makes of two clouds, from a guess."""

from __future__ import annotations

import numpy as np
import pytest

from idam import load_model, rigid
from idam.network.model import IDAM
from idam.network.propose import propose
from motions import rigid as pose
from solids import shell


@pytest.fixture(scope="module")
def network() -> IDAM:
    return load_model("gnn-unseen-shapes")


def test_points_and_their_copies_are_laid_on_each_other(network: IDAM) -> None:
    source, truth = shell(700, seed=1), pose([0.2, 0.3, -0.1], [0.1, -0.2, 0.3])
    found = propose(network, source, rigid.apply(truth, source), np.eye(4))
    assert np.degrees(rigid.angle(found[:3, :3].T @ truth[:3, :3])) < 2.0
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-12)


def test_the_guess_turns_the_source_before_the_network_sees_it(network: IDAM) -> None:
    source, truth = shell(700, seed=1), pose([2.4, 0.3, -0.1], [0.1, -0.2, 0.3])
    turned = pose([2.3, 0.2, 0.0], [0.0, 0.0, 0.0])
    found = propose(network, source, rigid.apply(truth, source), turned)
    by_hand = propose(network, rigid.apply(turned, source), rigid.apply(truth, source), np.eye(4)) @ turned
    np.testing.assert_allclose(found, by_hand, atol=1e-6)
    assert np.degrees(rigid.angle(found[:3, :3].T @ truth[:3, :3])) < 5.0
