"""Partners, kept pairs, the merged cloud, and the coordinates between."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from idam import rigid
from idam.clouds.surfaces import Surface
from idam.errors import InputError
from idam.io import PointCloud
from idam.many.choice import Choice, likeliest, most
from idam.many.cloud import fuse
from idam.many.frame import Frame
from idam.many.joint import correspondences, linearised, misses, scale, spreads
from idam.many.pairs import Kept
from idam.many.partners import PUT_TO_VOTE, all_pairs, candidates, likeliness, signatures, vote
from idam.many.scans import Thinned, described, read_scans, thinned
from many.worlds import surface as lumpy
from many.worlds import world
from rooms import room

RANDOM = np.random.default_rng(0)


def test_all_pairs_are_all_pairs() -> None:
    assert all_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_likeliest_partners_are_those_not_tried_yet() -> None:
    scores = np.array([[0, 3, 2, 1], [3, 0, 0, 0], [2, 0, 0, 5], [1, 0, 5, 0]], float)
    assert likeliest(scores, 1, range(4), set()) == {(0, 1), (2, 3)}
    assert likeliest(scores, 1, [0], {(0, 1)}) == {(0, 2)}
    assert likeliest(scores, 9, [0], {(0, 1), (0, 2), (0, 3)}) == set()


def test_scans_short_of_links_get_those_they_overlap_most() -> None:
    shares = {(0, 1): 0.9, (0, 2): 0.8, (0, 3): 0.7, (1, 2): 0.6}
    assert most(shares, {0: 2}, set()) == {(0, 1), (0, 2)}
    assert most(shares, {0: 2}, {(0, 1)}) == {(0, 2), (0, 3)}
    assert most(shares, {2: 1, 1: 1}, set()) == {(0, 1), (0, 2)}
    assert most(shares, {}, set()) == set()


def test_unsure_scans_try_likely_ones_of_other_components_alone() -> None:
    scores = 1 / (1.0 + np.abs(np.arange(40)[:, None] - np.arange(40)))
    choice = Choice(40, 4, lambda: scores)
    first = choice.next(range(40), [0] * 40, {}, range(40))
    component = [scan % 2 for scan in range(40)]
    again = choice.next([0, 1], [9] * 40, {}, component)
    assert len(first) == len(set(first))
    assert set(first).isdisjoint(again)
    assert again
    assert all(component[one] != component[other] and {one, other} & {0, 1} for one, other in again)


def test_candidates_grow_with_the_number_of_scans() -> None:
    for count in (30, 60, 120):
        signature = RANDOM.normal(size=(count, 16))
        pairs = candidates(signature)
        assert len(pairs) == len(set(pairs)) <= PUT_TO_VOTE * count
        assert all(one < other for one, other in pairs)
        alike = signature @ signature.T - 1e9 * np.eye(count)
        assert {tuple(sorted((i, int(alike[i].argmax())))) for i in range(count)} <= set(pairs)


def test_signatures_tell_places_and_are_the_same_in_any_order() -> None:
    places = [RANDOM.normal(size=(300, 16)) for _ in range(3)]
    scans = [place + 0.1 * RANDOM.normal(size=place.shape) for place in places for _ in range(2)]
    signature = signatures([scan.astype(np.float32) for scan in scans])
    alike = signature @ signature.T
    np.testing.assert_allclose(np.diag(alike), 1, atol=1e-6)
    for scan in range(6):
        assert np.argsort(-alike[scan])[1] // 2 == scan // 2


def test_a_vote_for_the_same_place_beats_one_for_another() -> None:
    points, features = RANDOM.normal(size=(100, 3)), RANDOM.normal(size=(100, 16))
    turned = rigid.apply(rigid.exp(RANDOM.normal(size=6)), points)
    same = vote(points, features, turned, features + 0.3 * RANDOM.normal(size=(100, 16)), 0.05)
    other = vote(points, features, RANDOM.normal(size=(100, 3)), RANDOM.normal(size=(100, 16)), 0.05)
    assert same > 20 * max(other, 1)


def test_a_vote_changes_with_no_pose() -> None:
    points, features = RANDOM.normal(size=(50, 3)), RANDOM.normal(size=(50, 8))
    other, theirs = RANDOM.normal(size=(50, 3)), features + RANDOM.normal(size=(50, 8))
    turned = rigid.apply(rigid.exp(RANDOM.normal(size=6)), other)
    assert vote(points, features, other, theirs, 0.5) == vote(points, features, turned, theirs, 0.5)


def test_scans_of_one_object_are_likelier_partners_than_of_two() -> None:
    one, other = world(3, seed=3, points=3000), world(3, seed=4, points=3000)
    _, scans = read_scans([*one.scans, *other.scans])
    scores = likeliness(*described([scan for scan in scans if not isinstance(scan, str)]))
    np.testing.assert_array_equal(scores, scores.T)
    for scan in range(6):
        best = int(np.argsort(-scores[scan])[0])
        assert best // 3 == scan // 3


def test_kept_rows_come_back_and_a_torn_line_does_not(tmp_path: Path) -> None:
    path = tmp_path / "pairs.jsonl"
    row = {"error": "", "transformation": np.eye(4).tolist(), "information": np.eye(6).tolist()}
    row |= {"confidence": 0.5, "reach": 0.1}
    kept = Kept(path)
    for key in "abc":
        kept.add(key, row)
    path.write_text(path.read_text()[:-5])
    again = Kept(path)
    assert set(again.rows) == {"a", "b"}
    again.add("d", row)
    assert set(Kept(path).rows) == {"a", "b", "d"}
    path.write_text(path.read_text() + "no json\n[1]\n{}\n" + json.dumps({**row, "key": "e", "reach": None}) + "\n")
    assert set(Kept(path).rows) == {"a", "b", "d"}


def test_kept_rows_are_in_the_file_as_soon_as_they_are_added(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "pairs.jsonl")
    kept.add("a", {"value": 1.5})
    assert json.loads((tmp_path / "pairs.jsonl").read_text()) == {"key": "a", "value": 1.5}
    with pytest.raises(InputError, match="cannot be written"):
        Kept(tmp_path / "none" / "pairs.jsonl").add("a", {})
    with pytest.raises(InputError, match="cannot be read"):
        Kept(tmp_path)


def test_fused_points_are_the_means_of_their_voxels() -> None:
    points = RANDOM.uniform(0, 3, (500, 3))
    points[0] = 0  # where the grid begins
    colors = RANDOM.integers(0, 256, (500, 3), dtype=np.uint8)
    normals = RANDOM.normal(size=(500, 3))
    halves = [PointCloud(points[rows], colors[rows], normals[rows]) for rows in (slice(0, 200), slice(200, 500))]
    fused = fuse(halves, 1.0, [4, 7])
    cells = np.floor(points).astype(int)
    expected = sorted(map(tuple, np.unique(cells, axis=0)))
    assert len(fused.points) == len(expected)
    for place, cell in enumerate(expected):
        inside = (cells == cell).all(1)
        np.testing.assert_allclose(fused.points[place], points[inside].mean(0))
        np.testing.assert_allclose(fused.colors[place], colors[inside].mean(0), atol=0.5 + 1e-9)
        mean = normals[inside].mean(0)
        np.testing.assert_allclose(fused.normals[place], mean / np.linalg.norm(mean))
        assert fused.attributes["scan"][place] == (4 if inside[:200].any() else 7)


def test_what_cannot_be_fused_is_refused() -> None:
    with pytest.raises(InputError, match="no scan has a pose"):
        fuse([], 1.0, [])
    with pytest.raises(InputError, match="too small"):
        fuse([PointCloud(RANDOM.normal(size=(10, 3)))], 1e-12, [0])


def test_the_frame_leaves_as_it_enters() -> None:
    frame = Frame(RANDOM.normal(size=(3, 3)) * 1000, 7.0)
    true = rigid.exp(RANDOM.normal(size=(3, 6)))
    working = np.stack([np.eye(4), *(frame.enter(scan, 0, rigid.inverse(true[0]) @ true[scan]) for scan in (1, 2))])
    final = frame.leave(working, [[0, 1, 2]])
    np.testing.assert_allclose(final, rigid.inverse(true[0]) @ true, atol=1e-9)


def test_the_covariance_in_the_frame_is_that_of_the_transform() -> None:
    """By its own meaning: draw transforms with that information, and see how they scatter once they have entered."""
    frame = Frame(np.array([[3.0, -2.0, 1.0], [0.5, 0.0, 2.0]]), 5.0)
    root = 1e-3 * RANDOM.normal(size=(6, 6))
    covariance = root @ root.T
    true = rigid.exp(RANDOM.normal(size=6))
    drawn = true @ rigid.exp(RANDOM.multivariate_normal(np.zeros(6), covariance, 4000))
    entered = np.stack([frame.enter(0, 1, each) for each in drawn])
    scatter = np.cov(rigid.log(rigid.inverse(frame.enter(0, 1, true)) @ entered).T)
    expected = frame.covariance(0, np.linalg.inv(covariance))
    np.testing.assert_allclose(scatter, expected, atol=0.08 * np.abs(expected).max())


def wall(seen_from: float, points: int) -> Thinned:
    """One face of a wall at x = 0, seen from in front of it or from behind, and a floor and a side that go through."""
    grid = RANDOM.uniform(-1, 1, (points, 2))
    faces = [np.stack([np.full(points, 0.02 * np.sign(seen_from)), grid[:, 0], grid[:, 1]], 1)]
    rest = RANDOM.uniform(-1, 1, (2, points, 2))
    faces += [np.stack([rest[0, :, 0], rest[0, :, 1], np.full(points, -1.0)], 1)]
    faces += [np.stack([rest[1, :, 0], np.full(points, -1.0), rest[1, :, 1]], 1)]
    surface = Surface.of(np.concatenate(faces))
    away = ((np.array([seen_from, 0, 0]) - surface.points) * surface.normals).sum(1, keepdims=True) < 0
    return Thinned(surface.points, np.where(away, -surface.normals, surface.normals), surface.tree, 0.04, True)


def test_the_two_faces_of_a_wall_do_not_pull_on_each_other() -> None:
    front, behind = wall(3.0, 1500), wall(-3.0, 1500)
    mine, _ = correspondences(front, behind, np.eye(4), 0.2, 10_000)
    inner = np.abs(front.points[mine, 0]) < 0.03
    floor = (front.points[mine, 2] < -0.95) | (front.points[mine, 1] < -0.95)
    assert not (inner & ~floor).any()
    assert floor.sum() > 1000
    unknown = replace(front, faces=False)
    mine, _ = correspondences(unknown, behind, np.eye(4), 0.2, 10_000)
    assert ((np.abs(front.points[mine, 0]) < 0.03) & (front.points[mine, 2] > -0.95)).sum() > 500


def test_scans_count_as_scans_where_most_of_the_others_are() -> None:
    scans, model = [room(3000), room(3000, seed=1)], lumpy(0, 3000, np.random.default_rng(0))
    _, one_model = read_scans([*scans, model])
    assert all(each.faces for each in thinned(one_model, 1.0))
    _, two_models = read_scans([scans[0], model, model + 1.0])
    assert [each.faces for each in thinned(two_models, 1.0)] == [True, False, False]


def test_surfaces_apart_weigh_less_than_those_that_are_the_same() -> None:
    """A quarter of the points seems to lie on the other face of a wall: it must not move what the rest holds."""
    same = Surface.of(RANDOM.uniform(-1, 1, (4000, 3)) * [1, 1, 0])
    points = same.points.copy()
    points[:1000, 2] += 0.05
    one = Thinned(points, np.tile([0, 0, 1.0], (4000, 1)), same.tree, 0.03, True)
    other = Thinned(same.points, np.tile([0, 0, 1.0], (4000, 1)), same.tree, 0.03, True)
    rows = correspondences(one, other, np.eye(4), 0.2, 10_000)
    common = scale([misses(one, other, np.eye(4), rows) + 0.003])
    hessian, gradient = linearised(one, other, np.eye(4), rows, common)
    assert abs(gradient[5] / hessian[5, 5]) < 0.05 / 4 / 20


def test_the_linear_system_is_the_derivative_of_its_cost() -> None:
    source, target = wall(3.0, 300), wall(3.0, 300)
    at = rigid.exp(np.array([0.01, -0.02, 0.015, 0.01, 0.0, -0.01]))
    rows = correspondences(source, target, at, 0.3, 10_000)
    hessian, gradient = linearised(source, target, at, rows, 1e6)  # nothing weighs less

    def cost(twist: np.ndarray) -> float:
        moved = rigid.apply(at @ rigid.exp(twist), source.points[rows[0]]) - target.points[rows[1]]
        spread = spreads(source.normals[rows[0]] @ at[:3, :3].T) + spreads(target.normals[rows[1]])
        return float((moved * np.linalg.solve(spread, moved[..., None])[..., 0]).sum()) / 2

    step = 1e-5
    for axis in range(6):
        x = step * np.eye(6)[axis]
        slope = (cost(x) - cost(-x)) / (2 * step)
        assert slope == pytest.approx(gradient[axis], rel=1e-4, abs=1e-4 * np.abs(gradient).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-6 * np.abs(hessian).max())
