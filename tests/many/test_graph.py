"""The robust pose graph: its derivatives, its solver, and that it finds the wrong links."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.many.elimination import Elimination
from idam.many.graph import (
    EVEN_ODDS,
    PRIOR,
    Links,
    barriers,
    jacobians,
    misfit,
    normal_equations,
    optimise,
    residuals,
    right_jacobian_inverse,
    solve,
    spanning_forest,
    tempered,
    truncated,
)
from idam.many.loops import find_loops
from idam.rigid import Array
from many.graphs import SPREAD, errors, information, links_of, made

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.049, 0.051, 0.5, 2.0, 3.1])
def test_right_jacobian_inverse_is_the_derivative_of_the_logarithm(angle: float) -> None:
    twist = RANDOM.normal(size=6)
    twist[:3] *= angle / np.linalg.norm(twist[:3])
    step = 1e-6
    columns = [
        (rigid.log(rigid.exp(twist) @ rigid.exp(x)) - rigid.log(rigid.exp(twist) @ rigid.exp(-x))) / (2 * step)
        for x in step * np.eye(6)
    ]
    np.testing.assert_allclose(right_jacobian_inverse(twist), np.stack(columns, 1), atol=1e-7)


def test_jacobians_are_the_derivatives_of_the_residuals() -> None:
    graph = made(6, seed=1)
    poses = graph.poses @ rigid.exp(RANDOM.normal(scale=0.3, size=(6, 6)))
    along_source, along_target = jacobians(poses, graph.links, residuals(poses, graph.links))
    step = 1e-6
    for scan in range(6):
        for axis in range(6):
            x = np.zeros((6, 6))
            x[scan, axis] = step
            there, back = (residuals(poses @ rigid.exp(sign * x), graph.links) for sign in (1, -1))
            expected = (there - back) / (2 * step)
            for ends, derivative in ((graph.links.source, along_source), (graph.links.target, along_target)):
                touched = ends == scan
                np.testing.assert_allclose(derivative[touched, :, axis], expected[touched], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_elimination_solves_what_a_dense_solver_solves(seed: int) -> None:
    graph = made(15, partners=4, seed=seed)
    poses = graph.poses @ rigid.exp(RANDOM.normal(scale=0.1, size=(15, 6)))
    weights = RANDOM.uniform(0.1, 1, len(graph.links))
    diagonal, across, right = normal_equations(poses, graph.links, weights, residuals(poses, graph.links))
    dense = np.zeros((90, 90))
    for scan in range(15):
        dense[6 * scan : 6 * scan + 6, 6 * scan : 6 * scan + 6] = diagonal[scan] * (1 + 0.01 * np.eye(6))
    for one, other, block in zip(graph.links.source, graph.links.target, across, strict=True):
        dense[6 * one : 6 * one + 6, 6 * other : 6 * other + 6] += block
        dense[6 * other : 6 * other + 6, 6 * one : 6 * one + 6] += block.T
    expected = np.linalg.solve(dense, right.ravel()).reshape(15, 6)
    actual = Elimination(15, graph.links.source, graph.links.target).solve(diagonal, across, right, 0.01)
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9)


def test_without_noise_the_poses_are_exact() -> None:
    graph = made(20, wrong=0.0)
    exact = Links(
        graph.links.source,
        graph.links.target,
        rigid.inverse(graph.poses[graph.links.target]) @ graph.poses[graph.links.source],
        graph.links.information,
        graph.links.confidence,
    )
    start = graph.poses @ rigid.exp(RANDOM.normal(scale=0.2, size=(20, 6)))
    poses = solve(start, exact, np.ones(len(exact)))
    assert errors(graph.poses, poses).max() < 1e-6
    assert misfit(poses, exact).max() < 1e-6


def test_a_precise_link_outweighs_a_vague_one() -> None:
    here, there = rigid.exp(np.zeros(6)), rigid.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    links = links_of([(0, 1, here, 0.9), (0, 1, there, 0.9)])
    precise = links.information * np.array([99.0, 1.0])[:, None, None]
    poses = solve(np.tile(np.eye(4), (2, 1, 1)), Links(*ends(links), precise, links.confidence), np.ones(2))
    np.testing.assert_allclose((rigid.inverse(poses[1]) @ poses[0])[0, 3], 0.01, atol=1e-6)


def ends(links: Links) -> tuple[Array, Array, Array]:
    return links.source, links.target, links.measured


def test_scans_that_no_link_holds_stay_where_they_are() -> None:
    graph = made(10, wrong=0.0)
    poses = np.concatenate([graph.poses, rigid.exp(RANDOM.normal(size=(1, 6)))])
    moved = solve(poses @ rigid.exp(RANDOM.normal(scale=0.01, size=(11, 6))), graph.links, np.ones(len(graph.links)))
    assert np.isfinite(moved).all()
    still = solve(poses, graph.links, np.ones(len(graph.links)))
    np.testing.assert_allclose(still[10], poses[10], atol=1e-12)


@pytest.mark.parametrize(("count", "partners", "seed"), [(20, 6, 0), (20, 6, 1), (40, 8, 2)])
def test_thirty_percent_wrong_links_are_found_and_no_right_one(count: int, partners: int, seed: int) -> None:
    graph = made(count, partners=partners, seed=seed)
    loops = find_loops(count, graph.links)
    poses, agrees = optimise(count, graph.links, loops.closed(len(graph.links)))
    assert not (agrees & graph.wrong).any()
    assert (~agrees & ~graph.wrong).sum() <= 0.02 * len(graph.links)  # the quantile's share, and the unsure ones'
    assert errors(graph.poses, poses).max() < 10 * SPREAD


def test_a_chain_stands_among_twice_as_many_wrong_links() -> None:
    poses = rigid.exp(RANDOM.normal(size=(16, 6)))
    ends = [(i, i + step) for step in (1, 2) for i in range(16 - step)]
    off = rigid.exp(RANDOM.normal(scale=SPREAD, size=(len(ends), 6)))
    right = [(i, j, rigid.inverse(poses[j]) @ poses[i] @ each, 0.97) for (i, j), each in zip(ends, off, strict=True)]
    far = [(i, j) for i in range(16) for j in range(i + 3, 16)]
    wrong = [(*far[k], rigid.exp(RANDOM.normal(size=6)), RANDOM.uniform(0, 0.7)) for k in RANDOM.permutation(91)[:58]]
    links = links_of([*right, *wrong])
    found, agrees = optimise(16, links, find_loops(16, links).closed(len(links)))
    np.testing.assert_array_equal(agrees, np.arange(len(links)) < len(right))
    assert errors(poses, found).max() < 20 * SPREAD


def test_a_sure_link_outvotes_two_unsure_ones_that_agree() -> None:
    poses = rigid.exp(RANDOM.normal(size=(3, 6)))
    right = [(s, t, rigid.inverse(poses[t]) @ poses[s], c) for s, t, c in ((0, 1, 0.99), (1, 2, 0.98))]
    other = poses.copy()
    other[2] = other[2] @ rigid.exp(np.array([0, 0, 1.0, 1.0, 0, 0]))
    alike = [(0, 2, rigid.inverse(other[2]) @ other[0], 0.3)] * 2
    links = links_of([*right, *alike])
    _, agrees = optimise(3, links, np.zeros(4, np.int64))
    assert agrees.tolist() == [True, True, False, False]


def test_the_answer_does_not_hang_on_the_order_of_the_links() -> None:
    graph = made(15, seed=4)
    order = RANDOM.permutation(len(graph.links))
    answers = []
    for links in (graph.links, graph.links[order]):
        poses, agrees = optimise(15, links, find_loops(15, links).closed(len(links)))
        answers.append((rigid.inverse(poses[0]) @ poses, agrees))
    np.testing.assert_allclose(answers[0][0], answers[1][0], atol=1e-6)
    np.testing.assert_array_equal(answers[0][1][order], answers[1][1])


def test_same_links_same_bits() -> None:
    graph = made(20, seed=5)
    support = find_loops(20, graph.links).closed(len(graph.links))
    one, other = (optimise(20, graph.links, support) for _ in range(2))
    np.testing.assert_array_equal(one[0], other[0])


def test_barrier_grows_with_the_odds() -> None:
    c = np.array([0.001, 0.1, 0.5, 0.9, 0.999])
    np.testing.assert_allclose(barriers(c), EVEN_ODDS + 2 * PRIOR * np.log(c / (1 - c)))
    assert barriers(np.array([0.0, 1.0]))[0] < 0 < barriers(np.array([0.0, 1.0]))[1] < np.inf


@pytest.mark.parametrize("sharpness", [1e-3, 1.0, 1e3])
def test_weights_go_from_one_to_nothing(sharpness: float) -> None:
    weights = tempered(np.linspace(0, 10, 1001), sharpness)
    assert weights[0] == 1
    assert (np.diff(weights) <= 1e-12).all()
    assert ((weights >= 0) & (weights <= 1)).all()


def test_sharp_weights_truncate() -> None:
    np.testing.assert_allclose(tempered(np.array([0.0, 0.99, 1.01, 5.0]), 1e6), [1, 1, 0, 0], atol=1e-2)


def test_truncated_cost_is_the_sum_of_what_links_cost() -> None:
    graph = made(10, seed=6)
    barrier = barriers(graph.links.confidence)
    costs = [min(value, most) for value, most in zip(misfit(graph.poses, graph.links), barrier, strict=True)]
    assert truncated(graph.poses, graph.links, barrier) == pytest.approx(sum(costs))


def test_spanning_forest_takes_the_strongest_links() -> None:
    links = links_of([(0, 1, np.eye(4), 0.9), (1, 2, np.eye(4), 0.5), (0, 2, np.eye(4), 0.8), (3, 4, np.eye(4), 0.1)])
    assert sorted(spanning_forest(5, links, links.confidence)) == [0, 2, 3]


def test_loops_close_where_all_links_are_right() -> None:
    graph = made(30, seed=7)
    loops = find_loops(30, graph.links)
    right = ~graph.wrong[loops.links].any(1)
    assert len(loops.links) > 20
    assert loops.closes[right].mean() > 0.95
    assert not loops.closes[~right].any()


def test_loop_error_is_what_remains_after_going_around() -> None:
    poses = rigid.exp(RANDOM.normal(size=(3, 6)))
    off = rigid.exp(np.array([0.1, 0, 0, 0.2, 0, 0]))
    links = links_of(
        [
            (0, 1, rigid.inverse(poses[1]) @ poses[0], 0.9),
            (2, 1, rigid.inverse(poses[1]) @ poses[2], 0.9),
            (0, 2, rigid.inverse(poses[2]) @ poses[0] @ off, 0.9),
        ]
    )
    loops = find_loops(3, links)
    assert loops.links.shape == (1, 3)
    assert np.linalg.norm(loops.error[0, :3]) == pytest.approx(0.1)


def test_loop_error_has_the_covariance_that_decides_whether_it_closes() -> None:
    truth = rigid.exp(RANDOM.normal(size=(3, 6)))
    count, closed = 500, 0
    noise = rigid.exp(RANDOM.normal(scale=SPREAD, size=(count, 3, 6)))
    for i in range(count):
        pairs = [(0, 1), (2, 1), (0, 2)]
        entries = [(s, t, rigid.inverse(truth[t]) @ truth[s] @ noise[i, k], 0.9) for k, (s, t) in enumerate(pairs)]
        closed += int(find_loops(3, links_of(entries)).closes[0])
    assert 0.97 < closed / count < 0.9999  # the 99 % quantile


def test_a_graph_without_links_is_no_error() -> None:
    empty = Links(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), information(0), np.zeros(0))
    poses, agrees = optimise(3, empty, find_loops(3, empty).closed(0))
    assert agrees.shape == (0,)
    assert np.isfinite(poses).all()
