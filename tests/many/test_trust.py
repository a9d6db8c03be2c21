"""Which scans hang together: nothing is joined by force, and nothing sure is wrong."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from idam import rigid
from idam.many.graph import doubted, optimise
from idam.many.loops import find_loops
from idam.many.trust import ALIKE, Trust, weigh
from idam.rigid import Array
from many.graphs import SPREAD, Made, errors, links_of, made

RANDOM = np.random.default_rng(0)


def judge(count: int, graph_links, threshold: float = 0.9) -> tuple[Array, Trust]:
    loops = find_loops(count, graph_links)
    poses, agrees = optimise(count, graph_links, loops.closed(len(graph_links)))
    return poses, weigh(poses, graph_links, agrees, [f"s{i}" for i in range(count)], threshold)


def off(graph: Made, poses: Array, scans: list[int]) -> float:
    return float(errors(graph.poses[scans], poses[scans]).max())


@pytest.mark.parametrize("seed", range(3))
def test_thirty_percent_wrong_links_place_nothing_wrong(seed: int) -> None:
    graph = made(40, seed=seed)
    poses, trust = judge(40, graph.links)
    assert len(trust.components[0]) >= 37
    for scans in trust.components:
        assert off(graph, poses, scans) < 10 * SPREAD
    assert trust.confidence[trust.components[0]].min() > 0.8


@pytest.mark.parametrize("seed", range(3))
def test_scans_without_a_right_link_are_left_alone_and_told_of(seed: int) -> None:
    lost = (3, 11)
    graph = made(25, seed=seed, lost=lost)
    poses, trust = judge(25, graph.links)
    for scan in lost:
        assert [scan] in trust.components
        assert trust.confidence[scan] == 0
        assert "trustworthy" in trust.reason[scan] or "contradict" in trust.reason[scan]
    assert off(graph, poses, trust.components[0]) < 10 * SPREAD


def test_two_objects_are_two_components() -> None:
    one, other = made(12, partners=5, wrong=0.0, seed=1), made(8, partners=5, wrong=0.0, seed=2)
    entries = [
        (int(s) + first, int(t) + first, z, float(c))
        for graph, first in ((one, 0), (other, 12))
        for s, t, z, c in zip(
            graph.links.source, graph.links.target, graph.links.measured, graph.links.confidence, strict=True
        )
    ]
    entries += [(2, 14, rigid.exp(RANDOM.normal(size=6)), 0.3), (5, 17, rigid.exp(RANDOM.normal(size=6)), 0.4)]
    _, trust = judge(20, links_of(entries))
    assert [sorted(scans) for scans in trust.components] == [list(range(12)), list(range(12, 20))]
    assert all("apart" in trust.reason[scan] for scan in range(12, 20))


def rooms(cross: float, corridor: float) -> tuple[Array, list[tuple[int, int, Array, float]]]:
    """Two equal rooms, scans 0 to 4 and 5 to 9, joined by a corridor, 10 to 12: links across say the rooms are one."""
    inside = rigid.exp(RANDOM.normal(size=(5, 6)))
    away = rigid.exp(np.array([0, 0, 0.3, 9, 0, 0]))
    along = rigid.exp(np.array([[0, 0, 0.1 * i, 3.0 * i, 0, 0] for i in (1, 2, 3)]))
    poses = np.concatenate([inside, away @ inside, along])

    def measured(s: int, t: int) -> Array:
        return rigid.inverse(poses[t]) @ poses[s] @ rigid.exp(RANDOM.normal(scale=SPREAD, size=6))

    entries = [
        (s, t, measured(s, t), max(cross + 0.01, 0.97))
        for first in (0, 5)
        for s, t in combinations(range(first, first + 5), 2)
    ]
    entries += [(s, t, measured(s, t), corridor) for s, t in ((0, 10), (10, 11), (11, 12), (12, 5))]
    as_one = np.concatenate([inside, inside])
    entries += [
        (s, t, rigid.inverse(as_one[t]) @ as_one[s] @ rigid.exp(RANDOM.normal(scale=SPREAD, size=6)), cross)
        for s in range(5)
        for t in range(5, 10)
    ]
    return poses, entries


@pytest.mark.parametrize(("cross", "corridor"), [(0.95, 0.97), (0.9, 0.99), (0.6, 0.95)])
def test_two_equal_rooms_do_not_fall_together(cross: float, corridor: float) -> None:
    truth, entries = rooms(cross, corridor)
    poses, trust = judge(13, links_of(entries))
    for scans in trust.components:
        assert errors(truth[scans], poses[scans]).max() < 30 * SPREAD  # the corridor drifts
    assert any(set(range(5)) <= set(scans) for scans in trust.components)  # what is sure inside a room stays


@pytest.mark.parametrize(("confidence", "placed"), [(0.96, True), (0.94, False)])
def test_a_scan_that_hangs_on_one_link_is_flagged(confidence: float, placed: bool) -> None:
    graph = made(10, partners=5, wrong=0.0, seed=3)
    entries = [
        (int(s), int(t), z, 0.98)
        for s, t, z in zip(graph.links.source, graph.links.target, graph.links.measured, strict=True)
    ]
    entries.append((10, 4, rigid.exp(RANDOM.normal(size=6)), confidence))
    _, trust = judge(11, links_of(entries))
    assert (10 in trust.components[0]) == placed
    if placed:
        assert trust.confidence[10] == pytest.approx(doubted(np.array(confidence)), abs=1e-3)
        assert "hangs on one link, s10 to s4 (confidence 0.96)" in trust.reason[10]
    else:
        assert "s10 to s4 (confidence 0.94)" in trust.reason[10]
    assert trust.reason[:10] == [""] * 10


def test_two_links_that_agree_are_surer_than_one() -> None:
    poses = rigid.exp(RANDOM.normal(size=(3, 6)))
    entries = [(s, t, rigid.inverse(poses[t]) @ poses[s], c) for s, t, c in ((0, 1, 0.99), (0, 2, 0.9), (1, 2, 0.9))]
    _, trust = judge(3, links_of(entries))
    odds = 0.8 / 0.2 * 0.8 / ALIKE  # 0.8 is what is left of 0.9
    assert trust.confidence[2] == pytest.approx(odds / (1 + odds))
    _, alone = judge(3, links_of(entries[:2]), threshold=0.7)
    assert alone.confidence[2] == pytest.approx(0.8)


def test_confidences_are_doubted_and_stay_in_order() -> None:
    confidence = np.linspace(0, 1, 1001)
    less = doubted(confidence)
    assert (np.diff(less) > 0).all()
    assert (less <= confidence).all()
    assert (less[0], less[-1]) == (0, 1)
    assert less[950] == pytest.approx(0.9)


def test_links_too_weak_to_agree_by_more_than_chance_add_nothing() -> None:
    poses = rigid.exp(RANDOM.normal(size=(3, 6)))
    entries = [(s, t, rigid.inverse(poses[t]) @ poses[s], c) for s, t, c in ((0, 1, 0.99), (0, 2, 0.8), (1, 2, 0.1))]
    _, trust = judge(3, links_of(entries), threshold=0.5)
    assert trust.confidence[2] == pytest.approx(0.6)


def test_a_sure_link_that_contradicts_is_told_of() -> None:
    poses = rigid.exp(RANDOM.normal(size=(4, 6)))
    entries = [(s, t, rigid.inverse(poses[t]) @ poses[s], 0.95) for s, t in ((0, 1), (1, 2), (2, 3))]
    entries.append((0, 3, rigid.exp(RANDOM.normal(size=6)), 0.95))
    _, trust = judge(4, links_of(entries))
    assert len(trust.components) > 1
    assert any("contradict" in reason for reason in trust.reason)


def test_the_first_scan_of_a_component_is_the_reference() -> None:
    graph = made(10, partners=5, wrong=0.0)
    poses, agrees = optimise(10, graph.links, np.zeros(len(graph.links), np.int64))
    trust = weigh(poses, graph.links, agrees, list("abcdefghij"), 0.9, first=7)
    assert trust.components[0][0] == 7
    assert trust.confidence[7] == 1


def test_what_hangs_on_one_link_is_the_smaller_side_whatever_the_reference() -> None:
    poses = rigid.exp(RANDOM.normal(size=(5, 6)))
    entries = [(s, t, rigid.inverse(poses[t]) @ poses[s], 0.98) for s, t in [*combinations(range(4), 2), (3, 4)]]
    links = links_of(entries)
    trust = weigh(poses, links, np.ones(len(links), bool), list("abcde"), 0.9, first=4)
    assert trust.components == [[4, 0, 1, 2, 3]]
    assert [bool(reason) for reason in trust.reason] == [False] * 4 + [True]
    assert trust.confidence[:4] == pytest.approx(0.96, abs=0.01)
